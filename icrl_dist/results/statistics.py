"""Summaries of returns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def mean_and_error(returns: Float[np.ndarray, "tasks seeds episodes"]) -> tuple[np.ndarray, np.ndarray]:
    """Mean return of each episode over tasks and seeds, and its standard error over seeds; nan with a single seed."""
    by_seed = returns.mean(axis=0)
    count = len(by_seed)
    spread = by_seed.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.full(by_seed.shape[1], np.nan)
    return by_seed.mean(axis=0), spread
