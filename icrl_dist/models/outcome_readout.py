"""The OOD score: a linear readout of T_theta's states predicts outcomes, and its loss is compared with training's.

From the final state at a decision and the action taken, the readout predicts the change of the
observation and the reward.  Its loss, relative to its loss in held-out training tasks, measures how
far a context is from those of pretraining.  It is fitted after training, to fixed weights.
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
"""Lengths of the moving average of the loss, in transitions: the longest one that fits the history is used."""
RARE = 0.99
"""The quantile of the losses in held-out training tasks at which the OOD score is 1."""

_RIDGE = 1e-3  # relative to the mean square of the features
_FLOOR = 1e-3  # smallest standard deviation, of observations in [-1, 1]: avoids division by 0 for a constant component

Decisions = tuple[
    Float32[np.ndarray, "B D"],
    Float32[np.ndarray, "B S"],
    Int64[np.ndarray, " B"] | Float32[np.ndarray, "B A"],
    Float32[np.ndarray, " B"],
    Float32[np.ndarray, "B S"],
]
"""One step of B environments: T_theta's final state, the observation, the action, the reward and the next observation."""


@dataclass(frozen=True, eq=False)
class OutcomeModel:
    """A linear prediction of transitions from T_theta's states, and the distribution of its loss in training tasks."""

    readout: Float32[np.ndarray, "F O"]
    """Features, the outer product of (state, 1) and (action, 1), to outcome: the change of each observation
    component, scaled so that the spec's range is 2, and the reward."""
    deviation: Float32[np.ndarray, " O"]
    """Standard deviation of the readout's error in each outcome."""
    typical: Float32[np.ndarray, " W"]
    """Median of the mean loss over each of ``WINDOWS`` transitions in held-out training tasks."""
    rare: Float32[np.ndarray, " W"]
    """The ``RARE`` quantile of the same."""

    @classmethod
    def fit(cls, spec: Spec, decisions: Iterable[Decisions], heldout: Iterable[Decisions]) -> Self:
        """Fit by ridge regression to ``decisions`` and calibrate on ``heldout``; both yield one step of B environments."""
        count, gram, cross, squares = 0, np.zeros(()), np.zeros(()), np.zeros(())
        for step in decisions:
            x, y = _features(spec, step).astype(np.float64), _outcome(spec, step).astype(np.float64)
            count, gram, cross, squares = count + len(x), gram + x.T @ x, cross + x.T @ y, squares + (y * y).sum(axis=0)
        penalty = _RIDGE * np.trace(gram) / len(gram)
        readout = np.linalg.solve(gram + penalty * np.eye(len(gram)), cross)
        residual = squares - 2 * (readout * cross).sum(axis=0) + (readout * (gram @ readout)).sum(axis=0)
        deviation = np.sqrt(np.maximum(residual / count, _FLOOR**2))
        none = np.zeros(len(WINDOWS), np.float32)
        fitted = cls(readout.astype(np.float32), deviation.astype(np.float32), none, none)
        typical, rare = _quantiles(np.stack([fitted.loss(spec, step) for step in heldout], axis=1))
        return cls(fitted.readout, fitted.deviation, typical, rare)

    def loss(self, spec: Spec, decisions: Decisions) -> Float32[np.ndarray, " B"]:
        """Half the squared error in standard deviations, averaged over outcomes: a Gaussian -log N without constants."""
        error = (_outcome(spec, decisions) - _features(spec, decisions) @ self.readout) / self.deviation
        loss: np.ndarray = 0.5 * (error * error).mean(axis=1)
        return loss

    def surprise(self, losses: Float[np.ndarray, "B T"]) -> Float[np.ndarray, " B"]:
        """The OOD score of the latest losses: 0 at the median of training tasks, 1 at their ``RARE`` quantile.

        It is 0 before the first transition.
        """
        fitting = [number for number, length in enumerate(WINDOWS) if length <= losses.shape[1]]
        if not fitting:
            return np.zeros(len(losses))
        window = fitting[-1]
        mean = losses[:, -WINDOWS[window] :].mean(axis=1)
        score: np.ndarray = (mean - self.typical[window]) / (self.rare[window] - self.typical[window])
        return score

    def arrays(self) -> dict[str, np.ndarray]:
        """Copies of the arrays by name, as stored in a checkpoint."""
        return {name: getattr(self, name).copy() for name in ("readout", "deviation", "typical", "rare")}

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """The inverse of ``arrays``; None without arrays.  Raises TypeError for unknown or missing names."""
        return cls(**arrays) if arrays else None


def _features(spec: Spec, decisions: Decisions) -> Float32[np.ndarray, "B F"]:
    state, action = decisions[0], decisions[2]
    vector = np.eye(spec.actions, dtype=np.float32)[action] if spec.discrete else np.asarray(action, np.float32)
    one = np.ones((len(state), 1), np.float32)
    # Outer product of (state, 1) and (action, 1) per row, flattened: the readout depends on the action linearly.
    both = np.concatenate([state, one], axis=1)[:, :, None] * np.concatenate([vector, one], axis=1)[:, None]
    return both.reshape(len(state), -1)


def _outcome(spec: Spec, decisions: Decisions) -> Float32[np.ndarray, "B O"]:
    _, before, _, reward, after = decisions
    half = (np.array(spec.high, np.float32) - np.array(spec.low, np.float32)) / 2
    return np.concatenate([(after - before) / half, reward[:, None]], axis=1)


def _quantiles(losses: Float32[np.ndarray, "B T"]) -> tuple[Float32[np.ndarray, " W"], Float32[np.ndarray, " W"]]:
    """Median and ``RARE`` quantile of the mean loss over every window of each length in ``WINDOWS``.

    Lengths that exceed the history get the values of the longest one that fits.
    """
    found = []
    for length in WINDOWS:
        if length <= losses.shape[1]:
            means = sliding_window_view(losses.astype(np.float64), length, axis=1).mean(axis=-1)
            low, high = np.quantile(means, (0.5, RARE))
        found.append((low, max(high, low + 1e-6)))
    typical, rare = np.array(found, np.float32).T
    return typical, rare
