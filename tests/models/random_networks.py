"""Random networks with random inputs, and random operations on their deployments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from icrl_dist.config.sections import ModelConfig
from icrl_dist.models.deployed import Columns, Deployed, WindowColumns
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.types import Spec


class Case(NamedTuple):
    """A network, and the number of contexts that it is deployed in."""

    spec: Spec
    model: PretrainedTransformer
    batch: int


def case(rng: np.random.Generator, batch: int | None = None, scale: float = 0.3, window: int | None = None) -> Case:
    """A network of a random shape: width 1 to 130, weights of the standard deviation ``scale`` at width 32."""
    heads = int(rng.integers(1, 5))
    width = heads * int(rng.integers(1, 130 // heads + 1))
    observation, discrete = int(rng.integers(1, 4)), bool(rng.integers(2))
    spec = Spec((0.0,) * observation, (4.0,) * observation, int(rng.integers(1, 20)), 8, discrete)
    config = ModelConfig(int(rng.integers(1, 4)), heads, width, int(rng.integers(3)), window=window or int(rng.integers(1, 5)))
    return Case(spec, network(spec, config, int(rng.integers(1 << 30)), scale), batch or int(rng.choice([1, 2, 3, 20])))


def network(spec: Spec, config: ModelConfig, seed: int, scale: float) -> PretrainedTransformer:
    model, drawn = PretrainedTransformer(spec, config).eval(), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=drawn) * scale / max(1.0, config.width / 32) ** 0.5)
    return model


def columns(rng: np.random.Generator, spec: Spec, batch: int, length: int) -> Columns:
    shape = (batch, length)
    actions = rng.integers(0, spec.actions, shape) if spec.discrete else rng.uniform(-1, 1, (*shape, spec.actions))
    return Columns(
        rng.uniform(0, 4, (*shape, spec.observation)).astype(np.float32),
        actions if spec.discrete else actions.astype(np.float32),
        rng.uniform(0, 4, (*shape, spec.observation)).astype(np.float32),
        rng.random(shape).astype(np.float32),
    )


def window(of: Columns) -> WindowColumns:
    return WindowColumns(of.observations, of.actions, of.rewards)


def operations(
    rng: np.random.Generator, of: Case, deployments: Sequence[Deployed], count: int, longest: int = 300
) -> Iterator[list[np.ndarray]]:
    """Do the same random operations to all deployments; yields their outputs wherever there are some."""
    spec, config = of.spec, of.model.config
    for _ in range(count):
        kind = str(rng.choice(["append", "clear", "decide", "row", "window"], p=[0.3, 0.05, 0.3, 0.15, 0.2]))
        states = rng.uniform(0, 4, (of.batch, spec.observation)).astype(np.float32)
        if kind == "append":
            episode = columns(rng, spec, of.batch, int(rng.choice([0, 1, 2, 15, 17, 60, 127, 128, 129])))
            for one in deployments:
                if one.length + episode.rewards.shape[1] <= longest:
                    one.append(episode)
        elif kind == "clear":
            for one in deployments:
                one.clear()
        elif kind == "decide":
            yield [one.decide(states) for one in deployments]
        elif kind == "row":
            row, new = int(rng.integers(of.batch)), columns(rng, spec, 1, int(rng.choice([0, 1, 3, 20])))
            queries = rng.uniform(0, 4, (int(rng.integers(1, 20)), spec.observation)).astype(np.float32)
            yield [one.decide_row(row, queries, new) for one in deployments]
        elif config.window > 1:
            length = int(rng.integers(1, config.window + 1))
            seen = window(columns(rng, spec, of.batch, length))
            arrived = columns(rng, spec, of.batch, 1) if rng.random() < 0.7 and deployments[0].length < longest else None
            yield [one.decide_window(seen, arrived) for one in deployments]
