"""Figures of several trainings: one file per figure, from result rows to numbers to a matplotlib Figure."""
