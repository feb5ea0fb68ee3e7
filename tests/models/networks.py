"""A small transformer and inputs for it, shared by the tests of models."""

from __future__ import annotations

import torch
from torch import Tensor

from icrl_dist.config.sections import ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.types import Spec

SPEC = Spec(low=(0.0, 0.0), high=(4.0, 4.0), actions=5, horizon=8)
B, T, Q = 3, 20, 6


def build(layers: int = 3, heads: int = 2, width: int = 16, fourier: int = 0, spec: Spec = SPEC) -> PretrainedTransformer:
    """A model with no zero parameter and with attention far from uniform, so that every parameter has an effect."""
    torch.manual_seed(0)
    model = PretrainedTransformer(spec, ModelConfig(layers, heads, width, fourier))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.4)
    return model.eval()


def transitions(length: int = T, seed: int = 0, rows: int = B) -> Transitions:
    g = torch.Generator().manual_seed(seed)
    cells = torch.randint(0, 5, (rows, length + 1, 2), generator=g).float()
    actions = torch.randint(0, 5, (rows, length), generator=g)
    return Transitions(cells[:, :-1], actions, cells[:, 1:], torch.randint(0, 2, (rows, length), generator=g).float())


def states(count: int = Q, seed: int = 9) -> Tensor:
    return torch.randint(0, 5, (B, count, 2), generator=torch.Generator().manual_seed(seed)).float()


def part(context: Transitions, start: int, stop: int) -> Transitions:
    return Transitions(*(column[:, start:stop] for column in context))


def changed(context: Transitions, at: int) -> Transitions:
    """The context with every column of transition number ``at`` changed."""
    copies = Transitions(*(column.clone() for column in context))
    for column in (copies.observations, copies.next_observations):
        column[:, at] = 4 - column[:, at] + 0.5
    copies.actions[:, at] = (copies.actions[:, at] + 1) % 5
    copies.rewards[:, at] = 1 - copies.rewards[:, at]
    return copies
