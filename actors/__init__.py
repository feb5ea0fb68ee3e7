"""Rollout workers: ask for a job, do it with functions of ``icrl_dist``, and send its trajectories."""
