"""Sampling an action from given uniform numbers, without torch."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int64

FLOOR = 0.05
"""Smallest standard deviation of a Gaussian: without a floor, eq. (1) has no minimum where labels are certain."""


def sample(probabilities: Float[np.ndarray, "B A"], u: Float[np.ndarray, " B"]) -> Int64[np.ndarray, " B"]:
    """The action of each row that its uniform number u in [0, 1) selects."""
    edges = probabilities.astype(np.float64).cumsum(axis=1)
    return (u[:, None] * edges[:, -1:] >= edges[:, :-1]).sum(axis=1)


def sample_gaussian(
    mean: Float32[np.ndarray, "B A"], deviation: Float32[np.ndarray, "B A"], u: Float[np.ndarray, "B A"]
) -> Float32[np.ndarray, "B A"]:
    """The action of each row whose components the uniform numbers u in [0, 1) select, clipped to [-1, 1]."""
    from scipy.special import ndtri  # slow to import, and discrete actions do not need it

    return np.clip(mean + deviation * ndtri(np.clip(u, 1e-6, 1 - 1e-6)), -1.0, 1.0).astype(np.float32)
