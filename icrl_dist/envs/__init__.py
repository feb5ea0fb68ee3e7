"""Variation environments: ``make`` for one as a gymnasium.Env, ``batch`` for many at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from icrl_dist.envs import darkroom
from icrl_dist.envs.variation import VariationEnv
from icrl_dist.types import Spec, Step, Task, Variation


class Batch(Protocol):
    """B variation environments stepped together; each row draws from its own generator."""

    spec: Spec
    batch: int

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float[np.ndarray, "B S"]: ...

    def step(self, actions: Int[np.ndarray, " B"]) -> Step: ...


_BATCHES = {"darkroom": darkroom.DarkRoom}
_SPECS = {"darkroom": darkroom.spec}


def _known(kind: str) -> None:
    if kind not in _BATCHES:
        raise ValueError(f"task {kind!r}: no such problem; known: {', '.join(sorted(_BATCHES))}")


def batch(variations: Sequence[Variation]) -> Batch:
    """The variations as one batch.  Raises ValueError for an unknown problem or a mixed batch."""
    kinds = sorted({v.task.kind for v in variations})
    if len(kinds) != 1:
        raise ValueError(f"a batch holds variations of one problem, not {kinds}")
    _known(kinds[0])
    return _BATCHES[kinds[0]](variations)


def spec(task: Task) -> Spec:
    """Shape of the task's observations and actions."""
    _known(task.kind)
    return _SPECS[task.kind](task)


def make(variation: Variation) -> VariationEnv:
    """One variation environment (tau, phi) as a ``gymnasium.Env``.

    The adversary is part of the environment: the agent sees neither it nor its action,
    except in ``info["adversary"]`` (the overriding action, or -1).
    """
    return VariationEnv(variation, batch([variation]))
