"""Agents: load a trained model, act, observe, out-of-distribution (OOD) score."""
