"""A transformer with action windows and inputs for it, shared by the tests of windows and of their deployment."""

from __future__ import annotations

from typing import Any

import torch

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import make_run
from icrl_dist.config.sections import ModelConfig
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer, Transitions, Windows
from icrl_dist.types import Spec

HORIZON, LENGTH = 7, 4
B, T, R = 3, 15, 2
SPEC = Spec(low=(0.0, 0.0), high=(4.0, 4.0), actions=5, horizon=HORIZON)


def build(spec: Spec = SPEC, heads: int = 2, window: int = LENGTH, scale: float = 0.4) -> PretrainedTransformer:
    """A model in which every parameter has an effect."""
    torch.manual_seed(0)
    model = PretrainedTransformer(spec, ModelConfig(3, heads, 16, window=window)).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * scale)
    return model


def trained(model: PretrainedTransformer) -> TrainedModel:
    """The model as one that a run of its size has trained."""
    run = make_run(model=model.config)
    return TrainedModel(run, methods.of(run), model.spec, model)


def transitions(seed: int = 0) -> Transitions:
    g = torch.Generator().manual_seed(seed)
    states = torch.randint(0, 5, (B, T + 1, 2), generator=g).float()
    rewards = torch.randint(0, 2, (B, T), generator=g).float()
    return Transitions(states[:, :-1], torch.randint(0, 5, (B, T), generator=g), states[:, 1:], rewards)


def windows(seed: int = 5) -> Windows:
    g = torch.Generator().manual_seed(seed)
    states = torch.randint(0, 5, (B, R, LENGTH, 2), generator=g).float()
    return Windows(states, torch.randint(0, 5, (B, R, LENGTH), generator=g), torch.rand(B, R, LENGTH, generator=g))


def part(of: Any, *place: slice) -> Any:
    """The same rows of every column."""
    return type(of)(*(column[place] for column in of))
