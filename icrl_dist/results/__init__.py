"""Evaluation on held-out tasks: returns, statistics, figures and tables."""
