"""Benchmarks: ``icrl-dist bench NAME``, one file each."""
