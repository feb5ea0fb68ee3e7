"""QARL's curriculum: a Gamma distribution of the adversary's temperature that moves to lower temperatures.

An adversary of a high temperature acts almost at random; at temperature 0 it only maximizes its return.  The
temperature of an episode is the last component of both players' observations; at test it is 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64

from icrl_dist.config.robust import RobustConfig
from icrl_dist.types import Spec


def divergence(concentration: float, other: float) -> float:
    """KL divergence of one Gamma distribution from another one of the same rate, in nats; it does not depend on the rate."""
    from scipy.special import digamma, gammaln  # imported here because scipy is slow to import

    return float((concentration - other) * digamma(concentration) - gammaln(concentration) + gammaln(other))


def moved(concentration: float, target: float, most: float) -> float:
    """The concentration with the least KL(new || target) subject to KL(new || old) <= ``most`` nats (the teacher's update).

    The optimum over all distributions is a geometric mean of old and target.  Between two Gamma distributions of one rate
    this is a Gamma distribution of that rate, with a concentration between theirs: the one at which the constraint
    holds with equality, or the target.
    """
    from scipy.optimize import brentq

    if divergence(target, concentration) <= most:
        return target
    return float(brentq(lambda new: divergence(new, concentration) - most, concentration, target, xtol=1e-12, rtol=1e-12))


def with_temperature(spec: Spec, config: RobustConfig) -> Spec:
    """The spec of observations with the adversary's temperature as the last component."""
    return dataclasses.replace(spec, low=(*spec.low, 0.0), high=(*spec.high, config.most_temperature))


def appended(
    observation: Float[np.ndarray, "*B S"], temperature: float | Float[np.ndarray, "*#B"] = 0.0
) -> Float32[np.ndarray, "*B S1"]:
    """Observations with the temperature as their last component; 0, the default, is that of tests."""
    column = np.broadcast_to(np.asarray(temperature, np.float32), observation.shape[:-1])[..., None]
    return np.concatenate([observation.astype(np.float32), column], axis=-1)


class Curriculum:
    """The distributions of N tasks, each with its own performance bound."""

    def __init__(self, config: RobustConfig, bounds: Float[np.ndarray, " N"]) -> None:
        """``bounds``: the discounted return of each task at which its distribution moves."""
        self._config, self._bounds = config, np.asarray(bounds, np.float64)
        self.concentrations: Float64[np.ndarray, " N"] = np.full(len(self._bounds), config.first_concentration)
        """The present concentration of each task's distribution."""
        self._returns = np.zeros((0, len(self._bounds)))

    def temperatures(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, " N"]:
        """A temperature of each task, drawn with its own generator and clipped."""
        drawn = [rng.gamma(shape) for rng, shape in zip(rngs, self.concentrations, strict=True)]
        return np.clip(np.array(drawn) / self._config.rate, 0.0, self._config.most_temperature).astype(np.float32)

    def observe(self, returns: Float[np.ndarray, " N"]) -> None:
        """The discounted returns of one episode.  After ``teacher_episodes`` of them, tasks at their bound or above it move."""
        self._returns = np.vstack([self._returns, returns])
        if len(self._returns) < self._config.teacher_episodes:
            return
        mean, self._returns = self._returns.mean(axis=0), self._returns[:0]
        for row in np.flatnonzero(mean >= self._bounds):
            target, most = self._config.last_concentration, self._config.divergence
            self.concentrations[row] = moved(float(self.concentrations[row]), target, most)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that later draws and updates depend on."""
        return {"concentrations": self.concentrations.copy(), "returns": self._returns.copy()}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """The inverse of ``state``."""
        self.concentrations, self._returns = state["concentrations"].copy(), state["returns"].copy()


def discounted(rewards: Float[np.ndarray, "*B H"], gamma: float) -> Float64[np.ndarray, "*B"]:
    """The discounted return of each episode from its first step."""
    total: Float64[np.ndarray, "*B"] = np.asarray(rewards, np.float64) @ gamma ** np.arange(rewards.shape[-1])
    return total
