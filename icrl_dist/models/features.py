"""Observations and actions as inputs of the model, in numpy: ``PretrainedTransformer.features`` and its one-hot actions.

Only additions, multiplications and roundings of single numbers, so results are equal bit by bit on all processors.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Float64

from icrl_dist.types import Spec


class Features:
    """The inputs of a model for one spec; ``fourier``: see ``config.sections.ModelConfig``."""

    def __init__(self, spec: Spec, fourier: int) -> None:
        low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._scale, self._shift = 2 / (high - low), -(high + low) / (high - low)
        self._spec, self._fourier = spec, fourier

    def observations(self, observations: Float32[np.ndarray, "*B S"]) -> Float32[np.ndarray, "*B F"]:
        """Observations scaled to [-1, 1], with sine and cosine pairs of each component."""
        x = self._shift + np.asarray(observations, np.float32) * self._scale
        if not self._fourier:
            return x
        half = np.float32(0.5 * np.pi)
        with np.errstate(invalid="ignore"):  # as torch: the sine of infinity is nan without a warning
            waves = [wave for k in range(1, self._fourier + 1) for wave in sine_and_cosine(half * k * x)]
        return np.concatenate([x, *waves], axis=-1, dtype=np.float32)

    def actions(self, actions: np.ndarray) -> Float32[np.ndarray, "*B A"]:
        """Discrete actions one-hot, vectors as they are.  Raises ValueError for a discrete action that there is not."""
        if not self._spec.discrete:
            return np.asarray(actions, np.float32)
        if (outside := (actions < 0) | (actions >= self._spec.actions)).any():
            raise ValueError(f"action {actions[outside][0]}: expected one of 0..{self._spec.actions - 1}")
        return np.eye(self._spec.actions, dtype=np.float32)[actions]

    def transitions(
        self, observations: np.ndarray, actions: np.ndarray, next_observations: np.ndarray, rewards: np.ndarray
    ) -> Float32[np.ndarray, "*B I"]:
        """The inputs of ``embed_transition``: what ``PretrainedTransformer.tokens`` embeds."""
        columns = self.observations(observations), self.actions(actions), self.observations(next_observations)
        return np.concatenate([*columns, rewards[..., None]], axis=-1, dtype=np.float32)


def sine_and_cosine(x: Float32[np.ndarray, "*N"]) -> tuple[Float32[np.ndarray, "*N"], Float32[np.ndarray, "*N"]]:
    """Sine and cosine to the last place, of numbers up to 1e6 in size.  Those of libraries differ between processors."""
    angle = np.asarray(x, np.float64)
    turns = np.rint(angle * (2 / math.pi))  # quarter turns
    rest = angle - turns * (math.pi / 2)
    sine, cosine = _series(rest, 1), _series(rest, 0)
    quarter = turns.astype(np.int64) % 4
    sines = np.choose(quarter, [sine, cosine, -sine, -cosine])
    cosines = np.choose(quarter, [cosine, -sine, -cosine, sine])
    return sines.astype(np.float32), cosines.astype(np.float32)


def _series(x: Float64[np.ndarray, "*N"], first: int) -> Float64[np.ndarray, "*N"]:
    """The Taylor series of the cosine (``first`` = 0) or sine (1), for |x| up to pi / 4: to 1e-16."""
    total = np.zeros_like(x)
    for power in range(first + 16, first, -2):
        total = (1 + total) * (x * x) * (-1 / (power * (power - 1)))
    return (1 + total) * (x if first else 1)
