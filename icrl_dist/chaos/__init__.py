"""Fault injection: faults strike a run on a seeded schedule, and its digests must not change."""
