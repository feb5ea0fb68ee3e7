"""Starts and supervises the learner and the workers of one run."""
