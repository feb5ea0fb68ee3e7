"""The parts of benchmarks that only a problem can give: see ``Problem.benchmarks``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Int

from icrl_dist.problems.continuous.disturbance import DisturbanceExperts
from icrl_dist.training.batches import TrainingBatch
from icrl_dist.types import Spec, Variation


class LibraryEnv(NamedTuple):
    """One environment of the library that a problem comes from."""

    reset: Callable[[], object]
    step: Callable[[np.ndarray], object]
    model: Any
    """Its ``mujoco.MjModel``."""
    data: Any
    """Its ``mujoco.MjData``."""
    substeps: int
    """Simulation steps of one control step."""


class DrawnContexts(Protocol):
    """B contexts of T transitions with N query states each."""

    @property
    def query(self) -> Int[np.ndarray, "B N"]:
        """Numbers of the query states."""
        ...

    def batch(self, prefix: Int[np.ndarray, "B N"]) -> TrainingBatch:
        """As a training batch in which each query sees this many transitions."""
        ...


class PretrainingData(Protocol):
    """A distribution of contexts and labelled queries whose exact posterior is known."""

    spec: Spec

    def draw(self, stream: int, step: int, batch: int, queries: int) -> DrawnContexts:
        """Batch number ``step`` of a stream of batches; equal arguments give equal batches."""
        ...

    def floor(self, contexts: Any) -> float:
        """Cross-entropy of the exact posterior's decisions: the smallest loss that a model can have."""
        ...


@dataclass(frozen=True)
class Benchmarks:
    """What ``icrl-dist bench`` needs of one problem; a benchmark whose part is None does not have this problem."""

    rows: Callable[[np.random.Generator, int], list[Variation]]
    """So many variations for ``bench env``, each with an adversary of its own."""
    batch: int
    """Default number of these variations."""
    library: Callable[[Variation], LibraryEnv] | None = None
    """The library's own environment of a variation's task, for ``bench env``; None for a problem without a library."""
    experts: DisturbanceExperts | None = None
    """Experts and disturbances of ``bench disturbance``."""
    kept: Callable[[str, int, int, float], float] | None = None
    """``kept(disturbance, size, horizon, p)``, for ``bench ceilings``: the share of the optimal return that the optimal policy
    of the undisturbed task keeps."""
    pretraining: Callable[[int, int, int, int], PretrainingData] | None = None
    """``pretraining(seed, size, length, goals)``: data of ``bench incontext``, with contexts of ``length`` transitions."""
