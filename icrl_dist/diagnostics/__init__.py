"""Checks of a machine, a cluster file, a cluster or a stored trajectory, and the estimate before a run."""
