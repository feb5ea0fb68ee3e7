"""What T_theta's outputs say of an action: a law over the discrete ones, or a Gaussian over vectors in [-1, 1].

One pair of functions for each, chosen by the spec, so that nothing else of the model and its
deployment knows which kind of actions a game has.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int64
from scipy.special import ndtri
from torch import Tensor
from torch.nn import functional as F

from icrl_dist.models.sampling import sample
from icrl_dist.types import Spec

FLOOR = 0.05
"""Smallest standard deviation of a Gaussian: without a floor, eq. (1) has no minimum where labels are certain."""


class Head(Protocol):
    """How outputs are read."""

    outputs: int
    """Numbers that the model must give."""
    numbers: int
    """Uniform numbers that an action takes."""

    def features(self, actions: Tensor) -> Float[Tensor, "*B A"]:
        """Actions as the model reads them."""
        ...

    def loss(self, outputs: Float[Tensor, "*B O"], labels: Float[Tensor, "*B A"]) -> Float[Tensor, ""]:
        """-log T_theta(a* | ...) of eq. (1), in nats, averaged."""
        ...

    def log_likelihood(self, outputs: Float[Tensor, "*B O"], actions: Tensor) -> Float[Tensor, "*B"]:
        """log T_theta(a | ...), in nats."""
        ...

    def act(self, outputs: Float[Tensor, "B O"], u: Float[np.ndarray, "B U"]) -> np.ndarray:
        """The action of each row that its uniform numbers in [0, 1) pick."""
        ...


class Categorical:
    """A law over ``actions`` discrete actions; a label is a law over them."""

    numbers = 1

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
    """An independent Gaussian a component, clipped to [-1, 1]; a label is an action."""

    def __init__(self, actions: int) -> None:
        self.outputs, self.numbers = 2 * actions, actions

    def features(self, actions: Tensor) -> Float[Tensor, "*B A"]:
        return actions

    def loss(self, outputs: Float[Tensor, "*B O"], labels: Float[Tensor, "*B A"]) -> Float[Tensor, ""]:
        return -self.log_likelihood(outputs, labels).mean()

    def log_likelihood(self, outputs: Float[Tensor, "*B O"], actions: Tensor) -> Float[Tensor, "*B"]:
        mean, deviation = self._spread(outputs)
        away = (actions - mean) / deviation
        return (-0.5 * away**2 - deviation.log() - 0.5 * math.log(2 * math.pi)).sum(-1)

    def act(self, outputs: Float[Tensor, "B O"], u: Float[np.ndarray, "B U"]) -> Float[np.ndarray, "B A"]:
        mean, deviation = (part.cpu().numpy() for part in self._spread(outputs))
        normal = ndtri(np.clip(u, 1e-6, 1 - 1e-6))
        return np.clip(mean + deviation * normal, -1.0, 1.0).astype(np.float32)

    def _spread(self, outputs: Float[Tensor, "*B O"]) -> tuple[Float[Tensor, "*B A"], Float[Tensor, "*B A"]]:
        """Mean and standard deviation, the latter at least ``FLOOR``."""
        mean, raw = outputs.chunk(2, dim=-1)
        return mean, FLOOR + F.softplus(raw)


def head(spec: Spec) -> Head:
    """The head of this spec's actions."""
    return Categorical(spec.actions) if spec.discrete else Gaussian(spec.actions)
