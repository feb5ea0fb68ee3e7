"""The weights of ``models.gpt.GPT`` by name, with their shapes, without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

_NORM = {"weight": (1,), "bias": (1,)}
_BLOCK = {
    **{f"{norm}.{name}": shape for norm in ("norm_attention", "norm_feed") for name, shape in _NORM.items()},
    **{"qkv.weight": (3, 1), "qkv.bias": (3,), "out.weight": (1, 1), "out.bias": (1,)},
    **{"feed.0.weight": (4, 1), "feed.0.bias": (4,), "feed.2.weight": (1, 4), "feed.2.bias": (1,)},
}
"""Shapes of the weights of a block, in widths of the model."""


def layers_of(weights: Mapping[str, np.ndarray], heads: int) -> int:
    """The number of layers of these weights.

    Raises ValueError unless they are all weights of a trunk with these heads, in their shapes.
    """
    width = len(weights["norm.weight"])
    if heads < 1 or width % heads:
        raise ValueError(f"{heads} heads: expected a number that divides the width {width}")
    layers = len({name.split(".")[1] for name in weights if name.startswith("blocks.")})
    shapes = {f"blocks.{layer}.{name}": shape for layer in range(layers) for name, shape in _BLOCK.items()}
    for name, factors in {**shapes, **{f"norm.{name}": shape for name, shape in _NORM.items()}}.items():
        found, expected = weights.get(name), tuple(factor * width for factor in factors)
        if found is None or found.shape != expected:
            raise ValueError(f"weights {name}: {'missing' if found is None else found.shape}, expected the shape {expected}")
    return layers
