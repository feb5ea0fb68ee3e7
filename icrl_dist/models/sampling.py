"""Sampling an action from given uniform numbers, without torch."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64


def sample(probabilities: Float[np.ndarray, "B A"], u: Float[np.ndarray, " B"]) -> Int64[np.ndarray, " B"]:
    """The action of each row that its uniform number u in [0, 1) selects."""
    edges = probabilities.astype(np.float64).cumsum(axis=1)
    return (u[:, None] * edges[:, -1:] >= edges[:, :-1]).sum(axis=1)
