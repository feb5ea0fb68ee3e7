"""Soft actor-critic for experts: one expert by stable-baselines3, or many together in lockstep."""
