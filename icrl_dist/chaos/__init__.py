"""Faults on purpose: a run is disturbed on a seeded schedule and must end as if it had not been."""
