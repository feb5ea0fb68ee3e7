"""The adversary of the continuous problems: a network with fixed random weights (appendix C.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from icrl_dist.arrays import whole
from icrl_dist.config.toml import nearest
from icrl_dist.problems.checks import check_parameters
from icrl_dist.types import Adversary, Spec

HIDDEN = 64
"""Units in each of the two hidden layers."""
_GAIN = 3.0
"""Scale of the last layer's weights: with it outputs sometimes reach their bounds and change sign within an episode."""


_PARAMETERS = {"null": (), "network": ("seed", "inputs", "outputs", "strength")}
"""The families of adversaries, and their parameters."""


def network(seed: int, inputs: int, outputs: int, strength: float = 1.0) -> Adversary:
    """The adversary with weights drawn from ``seed``; it maps observations to actions in [-strength, strength]."""
    return Adversary.of("network", seed=seed, inputs=inputs, outputs=outputs, strength=strength)


def networks(rng: np.random.Generator, count: int, spec: Spec, outputs: int, strength: float) -> tuple[Adversary, ...]:
    """The K disturbances of one task (section 4.1)."""
    seeds = rng.integers(2**31, size=count)
    return tuple(network(int(seed), spec.observation, outputs, strength) for seed in seeds)


def weights(adversary: Adversary) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weights and biases of the three layers in turn, computed from the seed, always with the same bits."""
    inputs, outputs = int(adversary.number("inputs")), int(adversary.number("outputs"))
    rng = np.random.default_rng(int(adversary.number("seed")))
    layers: list[np.ndarray] = []
    for rows, columns, gain in ((inputs, HIDDEN, 1.0), (HIDDEN, HIDDEN, 1.0), (HIDDEN, outputs, _GAIN)):
        layers.append((gain * rng.standard_normal((rows, columns)) / np.sqrt(rows)).astype(np.float32))
        layers.append(rng.standard_normal(columns).astype(np.float32) * np.float32(0.1))
    return tuple(layers)  # type: ignore[return-value]


class Networks:
    """The adversaries of B variations, evaluated together."""

    def __init__(self, adversaries: Sequence[Adversary], spec: Spec, outputs: int) -> None:
        """Raises ValueError, with the nearest name, for an unknown family or parameter, and for other widths."""
        for one in adversaries:
            if one.kind not in _PARAMETERS:
                families = tuple(_PARAMETERS)
                raise ValueError(
                    f"adversary {one.kind!r}{nearest(one.kind, families)}: a continuous problem has {' and '.join(families)}"
                )
            check_parameters(one, _PARAMETERS[one.kind])
            if one.kind == "network" and (one["inputs"], one["outputs"]) != (spec.observation, outputs):
                raise ValueError(
                    f"adversary of {one['inputs']} inputs and {one['outputs']} outputs: this problem has {spec.observation} "
                    f"observation components and {outputs} of disturbance; make it with network(seed, inputs, outputs)"
                )
            if one.kind == "network":
                whole("adversary seed", one["seed"], 0)
                one.number("strength")
        self._rows = [row for row, one in enumerate(adversaries) if one.kind == "network"]
        self._layers = [np.stack(same) for same in zip(*(weights(adversaries[row]) for row in self._rows), strict=True)]
        self._strength = np.array([[adversaries[row].number("strength")] for row in self._rows], np.float32)
        self._shape = (len(adversaries), outputs)
        low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._middle, self._half = (low + high) / 2, (high - low) / 2

    def act(self, observation: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B F"]:
        """The disturbance of each row; 0 in rows without an adversary."""
        out = np.zeros(self._shape, np.float32)
        if self._rows:
            x = ((observation[self._rows] - self._middle) / self._half)[:, None]
            for number in range(0, len(self._layers), 2):
                x = np.tanh(x @ self._layers[number] + self._layers[number + 1][:, None])
            out[self._rows] = x[:, 0] * self._strength
        return out
