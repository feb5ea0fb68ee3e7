"""Metrics, alerts, crash records, and recognition of a run's processes."""
