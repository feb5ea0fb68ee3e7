"""Tests of icrl_dist.console."""
