"""Variation environments: ``make`` for one as a gymnasium.Env, ``batch`` for many at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32, Int

from icrl_dist.config.toml import nearest
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.gym_adapter import VariationEnv
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import Spec, Step, Task, Variation


class Batch(Protocol):
    """B variation environments stepped together; each row draws from its own generator."""

    spec: Spec
    batch: int

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float[np.ndarray, "B S"]: ...

    def step(self, actions: Int[np.ndarray, " B"] | Float32[np.ndarray, "B A"]) -> Step: ...


KINDS = ("darkroom", pick_place.KIND, *domains.PROBLEMS)
"""Every problem there is: the kinds of tasks."""


def _known(kind: str) -> None:
    if kind not in KINDS:
        raise ValueError(f"task {kind!r}: no such problem{nearest(kind, KINDS)}; known: {', '.join(KINDS)}")


def batch(variations: Sequence[Variation]) -> Batch:
    """The variations as one batch.  Raises ValueError for an unknown problem or a mixed batch."""
    kinds = sorted({v.task.kind for v in variations})
    if len(kinds) != 1:
        raise ValueError(f"a batch holds variations of one problem, not {kinds}")
    _known(kinds[0])
    if kinds[0] == "darkroom":
        return room.DarkRoom(variations)
    # MuJoCo takes a moment to import: only for those who simulate.
    if kinds[0] == pick_place.KIND:
        from icrl_dist.problems.metaworld import environment

        return environment.PickPlace(variations)
    from icrl_dist.problems.dmc import simulation

    return simulation.Variations(variations)


def spec(task: Task) -> Spec:
    """Shape of the task's observations and actions."""
    _known(task.kind)
    of = {"darkroom": room.spec, pick_place.KIND: pick_place.spec}.get(task.kind, domains.spec)
    return of(task)


def make(variation: Variation, render_mode: str | None = None) -> VariationEnv:
    """One variation environment (tau, phi) as a ``gymnasium.Env``; ``render_mode`` ``rgb_array`` for images.

    The adversary is part of the environment: the agent sees neither it nor its action,
    except in ``info["adversary"]`` (see ``Step.adversary``).
    """
    return VariationEnv(variation, batch([variation]), render_mode)
