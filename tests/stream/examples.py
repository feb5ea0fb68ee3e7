"""One example of each kind of message, encoded and decoded."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from icrl_dist.stream import schema, wire
from icrl_dist.types import NULL, Adversary, Identity, Job, Payload, Task, Trajectory, Variation, Weights

LIMIT = 1 << 20

VARIATIONS = (
    Variation(Task.of("darkroom", goal=(3, 4), size=10, horizon=100), NULL),
    Variation(Task.of("dmc", problem="walker-run", mass=5.0, scale=5), Adversary.of("override", alpha=(0.5, 2.0), p=0.1)),
    Variation(Task("empty"), Adversary.of("force", vector=(), seed=2**63, low=-1)),
)


def trajectory(steps: int = 5, queries: int = 3, variation: Variation = VARIATIONS[1]) -> Trajectory:
    rng = np.random.default_rng(steps)
    return Trajectory(
        identity=Identity("adapt", 0, 3, 1, 7),
        variation=variation,
        policy_version=2,
        weights_digest="ab",
        worker="w0",
        observations=rng.normal(size=(steps + 1, 2)).astype(np.float32),
        actions=rng.integers(0, 5, steps).astype(np.int16),
        rewards=rng.normal(size=steps).astype(np.float32),
        adversary=np.full(steps, -1, np.int16),
        queries=rng.normal(size=(queries, 2)).astype(np.float32),
        labels=rng.random((queries, 5)).astype(np.float32),
        prev_actions=rng.integers(0, 5, queries // 2).astype(np.int16),
        prev_rewards=rng.normal(size=queries // 2).astype(np.float32),
        origin="optimal",
    )


def vectors(steps: int = 5, queries: int = 3) -> Trajectory:
    """A trajectory with actions of four components and an adversary of three."""
    rng = np.random.default_rng(steps)
    shapes = {"actions": (steps, 4), "adversary": (steps, 3), "prev_actions": (queries // 2, 4), "labels": (queries, 4)}
    arrays: dict[str, Any] = {name: rng.uniform(-1, 1, shape).astype(np.float32) for name, shape in shapes.items()}
    return dataclasses.replace(trajectory(steps, queries), origin="expert", **arrays)


def weights() -> Weights:
    rng = np.random.default_rng(0)
    arrays: dict[str, np.ndarray] = {
        "embed.weight": rng.normal(size=(4, 3)).astype(np.float32),
        "scale": np.array(2.0, np.float64),
        "half": np.ones((2, 1, 2), np.float16),
        "none": np.zeros((0, 3), np.int64),
    }
    return Weights(3, arrays, wire.weights_digest(arrays))


@dataclass(frozen=True)
class ExamplePayload(Payload):
    beta: float
    count: int
    name: str


def read_payload(kind: str, data: object) -> Payload:
    return schema.read(ExamplePayload, data, "payload")


JOB = Job("adapt", "adapt", 1, 2, VARIATIONS, 4, 0, 2**40, ExamplePayload(1.0, 1, "x"), tasks=1, first=3)

ENCODED: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
    "weights": (wire.encode_weights(weights()), lambda data: wire.decode_weights(data, LIMIT)),
    "job": (wire.encode_job(JOB), lambda data: wire.decode_job(data, read_payload, LIMIT)),
    "message": (wire.encode_message("hello", a=[1, {"b": None}], c=b"x"), lambda data: wire.decode_message(data, LIMIT)),
}


def decode(data: bytes) -> Trajectory:
    return wire.decode_trajectory(data, LIMIT)


ALL = {
    "trajectory": (wire.encode_trajectory(trajectory()), decode),
    "vectors": (wire.encode_trajectory(vectors()), decode),
    **ENCODED,
}
