"""Policies without a model."""

from __future__ import annotations

import abc

import numpy as np
from jaxtyping import Float, Float32, Int64

from icrl_dist.copies import CopiedWhole
from icrl_dist.models.sampling import sample


class DiscretePolicy(CopiedWhole, abc.ABC):
    """A policy given by its probabilities over discrete actions."""

    @abc.abstractmethod
    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        """The distribution over actions in each row."""

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Int64[np.ndarray, " B"]:
        """The action of each row that its uniform number in [0, 1) selects."""
        return sample(self.probabilities(observation), u[:, 0])


class RandomPolicy(DiscretePolicy):
    """Uniform over the actions."""

    def __init__(self, actions: int) -> None:
        self._uniform = np.full(actions, 1.0 / actions)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        return np.broadcast_to(self._uniform, (len(observation), len(self._uniform)))

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> Float[np.ndarray, "1 Q A"]:
        """The distributions at any states, which never change."""
        return self.probabilities(states)[None]

    def observe(self, *transition: object) -> None:
        """Does nothing: the policy does not learn."""


class RandomVectorPolicy:
    """Uniform over vectors in [-1, 1]."""

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Float32[np.ndarray, "B U"]:
        """The vector that the uniform numbers in [0, 1) give."""
        return (2 * u - 1).astype(np.float32)

    def observe(self, *transition: object) -> None:
        """Does nothing: the policy does not learn."""
