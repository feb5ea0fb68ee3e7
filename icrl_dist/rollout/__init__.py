"""Deployment of policies in batches of environments (Algorithm 1)."""
