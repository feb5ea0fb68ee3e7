"""How fast variation environments step: one process, one core, an adversary in every row."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from icrl_dist import envs
from icrl_dist.config import ConfigError
from icrl_dist.envs import darkroom
from icrl_dist.envs.adversary import sample_dirichlet
from icrl_dist.types import Variation


def _darkroom(rng: np.random.Generator, batch: int) -> list[Variation]:
    """A random goal and an own Dirichlet adversary (p > 0) in every row of a 10x10 room."""
    goals = rng.integers(0, 10, size=(batch, 2)).tolist()
    return [Variation(darkroom.task(goal), sample_dirichlet(rng, darkroom.ACTIONS, 0.2)) for goal in goals]


_PROBLEMS = {"darkroom": _darkroom}


def run(problem: str = "darkroom", batch: int = 1024, seconds: float = 3.0) -> dict[str, Any]:
    """Step whole episodes of random actions for about ``seconds``.

    ``steps_per_s`` counts resets and steps; actions are drawn beforehand, for choosing them
    is the agent's work.  ``seeded_steps_per_s`` also makes each row's generator afresh from
    an identity at every reset, as the jobs of a run do.  Raises ConfigError for an unknown
    problem and for a batch or a time that is not above 0.
    """
    if problem not in _PROBLEMS:
        raise ConfigError(f"bench env: problem = {problem!r}: choose one of {', '.join(sorted(_PROBLEMS))}")
    if batch < 1:
        raise ConfigError(f"bench env: batch = {batch}: must be above 0")
    if not seconds > 0:
        raise ConfigError(f"bench env: seconds = {seconds}: must be above 0")
    rng = np.random.default_rng(0)
    env = envs.batch(_PROBLEMS[problem](rng, batch))
    actions = rng.integers(0, env.spec.actions, size=(env.spec.horizon, batch))
    kept = _seeded(0, batch)

    def episode(rngs: Callable[[], Sequence[np.random.Generator]]) -> float:
        began = time.perf_counter()
        env.reset(rngs())
        for row in actions:
            env.step(row)
        return time.perf_counter() - began

    episode(lambda: kept)  # finds cold caches
    plain: list[float] = []
    seeded: list[float] = []
    end = time.perf_counter() + seconds
    while not seeded or time.perf_counter() < end:
        # Taken in turns, so that a busy machine slows both alike.
        plain += [episode(lambda: kept) for _ in range(3)]
        seeded.append(episode(partial(_seeded, len(seeded), batch)))
    return {
        "problem": problem,
        "batch": batch,
        "seconds": seconds,
        "steps_per_s": actions.size * len(plain) / sum(plain),
        "seeded_steps_per_s": actions.size * len(seeded) / sum(seeded),
    }


def _seeded(episode: int, batch: int) -> list[np.random.Generator]:
    return [np.random.default_rng(np.random.SeedSequence(0, spawn_key=(episode, row))) for row in range(batch)]


def describe(result: dict[str, Any]) -> str:
    """The result in one line for people."""
    return (
        f"{result['problem']}: {result['steps_per_s'] / 1e6:.1f} million steps/s in batches of {result['batch']:,} "
        f"on one core, {result['seeded_steps_per_s'] / 1e6:.1f} with a generator keyed anew to every row and episode"
    )
