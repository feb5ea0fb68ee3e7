"""Policies without a model."""

from __future__ import annotations

import abc

import numpy as np
from jaxtyping import Float, Float32, Int64

from icrl_dist.copies import CopiedWhole
from icrl_dist.interfaces import Policy
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


class Exploring:
    """A policy that takes a random discrete action with probability ``share``, from episode number ``first`` on.

    The policy observes these actions as its own.  One uniform number decides both whether an action is random and which
    it is, so that an episode draws as many numbers as without exploration.
    """

    def __init__(self, policy: Policy, actions: int, share: float, first: int) -> None:
        self._policy, self._actions, self._share, self._first = policy, actions, share, first
        self._episode = 0

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B 1"]) -> Int64[np.ndarray, " B"]:
        """A random action where the uniform number in [0, 1) is below the share, else the policy's."""
        share = self._share if self._episode >= self._first else 0.0
        own = self._policy.act(observation, ((u - share) / (1 - share)).clip(0, 1 - 2**-53) if share < 1 else u)
        drawn = (u[:, 0] / share * self._actions).astype(np.int64) if share else own
        explored: Int64[np.ndarray, " B"] = np.where(u[:, 0] < share, drawn, own)
        return explored

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int64[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._policy.observe(observation, action, reward, next_observation, done)
        self._episode += done
