"""Robust policies: two SAC players in one simulation, the agent (protagonist) and an adversary (RARL, QARL)."""
