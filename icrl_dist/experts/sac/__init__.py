"""Learners of experts: soft actor-critic, one expert at a time and many in lockstep."""
