"""Training batches, the fit and its optimizers."""
