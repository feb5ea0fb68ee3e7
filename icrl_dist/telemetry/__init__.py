"""Metrics, alerts, crash reports, and the processes of a run."""
