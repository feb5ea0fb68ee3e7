"""Checks of a machine, a cluster or a run folder, and estimates before a run."""
