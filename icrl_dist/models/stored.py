"""The weights of a transformer in a checkpoint, held to their model and deployed without torch."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from icrl_dist.config.sections import ModelConfig
from icrl_dist.types import Spec

Shapes = Iterable[tuple[str, tuple[int, ...]]]
"""Names and shapes of the parameters of a model, in the order of its ``state_dict``."""


def check_shapes(expected: Shapes, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError naming the first arrays that differ, unless names and shapes are those expected."""
    unknown = dict(arrays)

    def differences() -> Iterator[str]:
        for name, shape in expected:
            if name not in unknown:
                yield f"{name} is missing"
            elif (found := unknown.pop(name).shape) != shape:
                yield f"{name} has shape {found}, not {shape}"
        yield from (f"{name} is unknown" for name in unknown)

    if wrong := list(itertools.islice(differences(), 5)):
        raise ValueError(f"weights of another model: {', '.join(wrong)}")


def shapes(spec: Spec, config: ModelConfig) -> Shapes:
    """Those of ``models.dpt.PretrainedTransformer``."""
    width, features = config.width, spec.observation * (1 + 2 * config.fourier)
    yield from _linear("embed_transition", 2 * features + spec.actions + 1, width)
    yield from _linear("embed_query", features, width)
    if config.window > 1:
        yield from _linear("embed_taken", features + spec.actions + 1, width)
    for number in range(config.layers):
        block = f"trunk.blocks.{number}"
        yield from _norm(f"{block}.norm_attention", width)
        yield from _linear(f"{block}.qkv", width, 3 * width)
        yield from _linear(f"{block}.out", width, width)
        yield from _norm(f"{block}.norm_feed", width)
        yield from _linear(f"{block}.feed.0", width, 4 * width)
        yield from _linear(f"{block}.feed.2", 4 * width, width)
    yield from _norm("trunk.norm", width)
    yield from _linear("head", width, spec.actions if spec.discrete else 2 * spec.actions)


def _linear(name: str, inputs: int, outputs: int) -> Shapes:
    return (f"{name}.weight", (outputs, inputs)), (f"{name}.bias", (outputs,))


def _norm(name: str, width: int) -> Shapes:
    return (f"{name}.weight", (width,)), (f"{name}.bias", (width,))


@dataclass(frozen=True, eq=False)
class StoredTransformer:
    """A trained ``models.dpt.PretrainedTransformer`` as arrays; ``rollout.deployment`` deploys it by the kernel."""

    spec: Spec
    config: ModelConfig
    weights: Mapping[str, np.ndarray]
    """By their names in a checkpoint, without ``model/``; float32."""

    @classmethod
    def of(cls, spec: Spec, config: ModelConfig, weights: Mapping[str, np.ndarray]) -> Self:
        """Raises ValueError, naming the arrays, unless the weights are those of this model."""
        np.array((spec.low, spec.high), np.float32)  # raises for what is no number
        check_shapes(shapes(spec, config), weights)
        if others := [f"{name} of type {array.dtype}" for name, array in weights.items() if array.dtype != np.float32]:
            raise ValueError(f"weights of another type than float32: {', '.join(others[:5])}")
        return cls(spec, config, weights)
