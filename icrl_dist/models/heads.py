"""Action heads: T_theta's outputs as a distribution over discrete actions, or a Gaussian over vectors in [-1, 1].

The spec chooses the head.  No other part of the model or its deployment depends on the kind of actions.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional as F

from icrl_dist.models.sampling import FLOOR, sample, sample_gaussian
from icrl_dist.types import Spec


class ActionHead(Protocol):
    """Turns the model's outputs into a loss, likelihoods and actions."""

    outputs: int
    """Outputs of the model per query."""
    uniforms: int
    """Uniform random numbers per action (U)."""

    def features(self, actions: Tensor) -> Float[Tensor, "*B A"]:
        """Actions as inputs of the model: one-hot, or as they are."""
        ...

    def loss(self, outputs: Float[Tensor, "*B O"], labels: Float[Tensor, "*B A"]) -> Float[Tensor, ""]:
        """The mean of -log T_theta(a* | ...) of eq. (1), in nats."""
        ...

    def log_likelihood(self, outputs: Float[Tensor, "*B O"], actions: Tensor) -> Float[Tensor, "*B"]:
        """log T_theta(a | ...), in nats."""
        ...

    def act(self, outputs: Float[Tensor, "B O"], u: Float[np.ndarray, "B U"]) -> np.ndarray:
        """The action of each row, sampled by its uniform numbers in [0, 1)."""
        ...


class Categorical:
    """A distribution over ``actions`` discrete actions; a label is a distribution over them too."""

    uniforms = 1

    def __init__(self, actions: int) -> None:
        self.outputs = actions

    def features(self, actions: Tensor) -> Float[Tensor, "*B A"]:
        return F.one_hot(actions, self.outputs).float()

    def loss(self, outputs: Float[Tensor, "*B O"], labels: Float[Tensor, "*B A"]) -> Float[Tensor, ""]:
        return -(labels * outputs.log_softmax(dim=-1)).sum(dim=-1).mean()

    def log_likelihood(self, outputs: Float[Tensor, "*B O"], actions: Tensor) -> Float[Tensor, "*B"]:
        return outputs.log_softmax(-1).gather(-1, actions.unsqueeze(-1)).squeeze(-1)

    def act(self, outputs: Float[Tensor, "B O"], u: Float[np.ndarray, "B U"]) -> Int64[np.ndarray, " B"]:
        return sample(outputs.softmax(-1).cpu().numpy(), u[:, 0])


class Gaussian:
    """An independent Gaussian per action component, clipped to [-1, 1]; a label is an action."""

    def __init__(self, actions: int) -> None:
        self.outputs, self.uniforms = 2 * actions, actions

    def features(self, actions: Tensor) -> Float[Tensor, "*B A"]:
        return actions

    def loss(self, outputs: Float[Tensor, "*B O"], labels: Float[Tensor, "*B A"]) -> Float[Tensor, ""]:
        return -self.log_likelihood(outputs, labels).mean()

    def log_likelihood(self, outputs: Float[Tensor, "*B O"], actions: Tensor) -> Float[Tensor, "*B"]:
        mean, deviation = self._mean_and_deviation(outputs)
        error = (actions - mean) / deviation
        return (-0.5 * error**2 - deviation.log() - 0.5 * math.log(2 * math.pi)).sum(-1)

    def act(self, outputs: Float[Tensor, "B O"], u: Float[np.ndarray, "B U"]) -> Float[np.ndarray, "B A"]:
        mean, deviation = (part.cpu().numpy() for part in self._mean_and_deviation(outputs))
        return sample_gaussian(mean, deviation, u)

    def _mean_and_deviation(self, outputs: Float[Tensor, "*B O"]) -> tuple[Float[Tensor, "*B A"], Float[Tensor, "*B A"]]:
        """Mean and standard deviation; the deviation is at least ``FLOOR``."""
        mean, raw = outputs.chunk(2, dim=-1)
        return mean, FLOOR + F.softplus(raw)


def action_head(spec: Spec) -> ActionHead:
    """The head for this spec's actions."""
    return Categorical(spec.actions) if spec.discrete else Gaussian(spec.actions)
