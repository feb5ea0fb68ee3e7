"""Robust in-context reinforcement learning, distributed."""
