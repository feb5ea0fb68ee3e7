"""What T_theta expects to happen: a linear readout of its own states, fitted once they no longer change.

From its final state at a decision and the action then taken, it predicts how the observation
changes and what reward comes.  How badly it does so, held against training tasks that the readout
was not fitted to, says how unlike pretraining a context is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float, Float32, Int64
from numpy.lib.stride_tricks import sliding_window_view

from icrl_dist.types import Spec

WINDOWS = (1, 2, 5, 10, 20, 50, 100)
"""Transitions that a loss is averaged over: the most that there are, up to the last."""
RARE = 0.99
"""The quantile of the held-out training tasks' losses at which surprise is 1."""

_RIDGE = 1e-3  # over the mean square of the features
_FLOOR = 1e-3  # smallest standard deviation, where the room is [-1, 1]: what never changes in training may not divide by 0

Decisions = tuple[
    Float32[np.ndarray, "B D"],
    Float32[np.ndarray, "B S"],
    Int64[np.ndarray, " B"] | Float32[np.ndarray, "B A"],
    Float32[np.ndarray, " B"],
    Float32[np.ndarray, "B S"],
]
"""Of B environments: T_theta's final state, the observation, the action, the reward and the next observation."""


@dataclass(frozen=True, eq=False)
class OutcomeModel:
    """Predicts a transition from T_theta's state before it, and knows what losses are usual."""

    readout: Float32[np.ndarray, "F O"]
    """Features (state and 1, times action and 1) to outcome: the change of each observation
    component, of which the spec's range is 2, and the reward."""
    deviation: Float32[np.ndarray, " O"]
    """Standard deviation of what the readout leaves of each."""
    typical: Float32[np.ndarray, " W"]
    """Median loss over each of ``WINDOWS`` in held-out training tasks."""
    rare: Float32[np.ndarray, " W"]
    """The loss there that one window in a hundred has (``RARE``)."""

    @classmethod
    def fit(cls, spec: Spec, decisions: Iterable[Decisions], heldout: Iterable[Decisions]) -> Self:
        """By ridge regression to ``decisions``, calibrated on ``heldout``: step by step, B environments each."""
        count, gram, cross, squares = 0, np.zeros(()), np.zeros(()), np.zeros(())
        for one in decisions:
            x, y = _features(spec, one).astype(np.float64), _outcome(spec, one).astype(np.float64)
            count, gram, cross, squares = count + len(x), gram + x.T @ x, cross + x.T @ y, squares + (y * y).sum(axis=0)
        penalty = _RIDGE * np.trace(gram) / len(gram)
        readout = np.linalg.solve(gram + penalty * np.eye(len(gram)), cross)
        left = squares - 2 * (readout * cross).sum(axis=0) + (readout * (gram @ readout)).sum(axis=0)
        deviation = np.sqrt(np.maximum(left / count, _FLOOR**2))
        none = np.zeros(len(WINDOWS), np.float32)
        made = cls(readout.astype(np.float32), deviation.astype(np.float32), none, none)
        typical, rare = _usual(np.stack([made.loss(spec, one) for one in heldout], axis=1))
        return cls(made.readout, made.deviation, typical, rare)

    def loss(self, spec: Spec, of: Decisions) -> Float32[np.ndarray, " B"]:
        """Half the squared error in standard deviations, averaged over the outcome: -log N, up to what is constant."""
        error = (_outcome(spec, of) - _features(spec, of) @ self.readout) / self.deviation
        loss: np.ndarray = 0.5 * (error * error).mean(axis=1)
        return loss

    def surprise(self, losses: Float[np.ndarray, "B T"]) -> Float[np.ndarray, " B"]:
        """How unusual the latest losses are: 0 is typical of training, 1 is what one window in a hundred reaches there."""
        seen = [number for number, length in enumerate(WINDOWS) if length <= losses.shape[1]]
        if not seen:
            return np.zeros(len(losses))
        window = seen[-1]
        mean = losses[:, -WINDOWS[window] :].mean(axis=1)
        surprise: np.ndarray = (mean - self.typical[window]) / (self.rare[window] - self.typical[window])
        return surprise

    def arrays(self) -> dict[str, np.ndarray]:
        """As a checkpoint keeps it."""
        return {name: getattr(self, name) for name in ("readout", "deviation", "typical", "rare")}

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """The inverse of ``arrays``; None if there are none.  Raises TypeError for others."""
        return cls(**arrays) if arrays else None


def _features(spec: Spec, of: Decisions) -> Float32[np.ndarray, "B F"]:
    state, action = of[0], of[2]
    taken = np.eye(spec.actions, dtype=np.float32)[action] if spec.discrete else np.asarray(action, np.float32)
    one = np.ones((len(state), 1), np.float32)
    both = np.concatenate([state, one], axis=1)[:, :, None] * np.concatenate([taken, one], axis=1)[:, None]
    return both.reshape(len(state), -1)


def _outcome(spec: Spec, of: Decisions) -> Float32[np.ndarray, "B O"]:
    _, before, _, reward, after = of
    half = (np.array(spec.high, np.float32) - np.array(spec.low, np.float32)) / 2
    return np.concatenate([(after - before) / half, reward[:, None]], axis=1)


def _usual(losses: Float32[np.ndarray, "B T"]) -> tuple[Float32[np.ndarray, " W"], Float32[np.ndarray, " W"]]:
    """Median and ``RARE`` quantile of the mean loss over windows of each length that fits, anywhere in a row.

    The longest that fits stands for those that do not.
    """
    found = []
    for length in WINDOWS:
        if length <= losses.shape[1]:
            means = sliding_window_view(losses.astype(np.float64), length, axis=1).mean(axis=-1)
            low, high = np.quantile(means, (0.5, RARE))
        found.append((low, max(high, low + 1e-6)))
    typical, rare = np.array(found, np.float32).T
    return typical, rare
