"""Sweeps: many runs from one file, side by side and resumable, with their result rows in one file."""
