"""Steps per second of variation environments: one process, one core, an adversary in every row."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.problems import registry
from icrl_dist.problems.benchmarks import Benchmarks, LibraryEnv
from icrl_dist.types import Variation

Library = Callable[[Variation], LibraryEnv]


def run(problem: str = "darkroom", batch: int | None = None, seconds: float = 3.0) -> dict[str, Any]:
    """Step whole episodes of random actions for about ``seconds``.

    Actions are drawn beforehand, because choosing them is the agent's work.  For a problem without a library
    ``steps_per_s`` includes resets, and ``seeded_steps_per_s`` also creates each row's generator from an
    identity at every reset, as the jobs of a run do.  For a problem of a library (DeepMind Control, Meta-World)
    ``ratio`` is our steps/s divided by those of a loop over the library's own environments, and ``limit_ratio``
    divided by those of MuJoCo's ``mj_step`` alone; the three alternate.  Raises ConfigError for an unknown problem
    and for a batch or a time that is not above 0.
    """
    known = {name: part for name in registry.names() if (part := registry.problem(name).benchmarks) is not None}
    if problem not in known:
        raise ConfigError(f"bench env: problem = {problem!r}{nearest(problem, tuple(known))}: choose one of {', '.join(known)}")
    part = known[problem]
    batch = part.batch if batch is None else batch
    if batch < 1:
        raise ConfigError(f"bench env: batch = {batch}: must be above 0")
    if not seconds > 0:
        raise ConfigError(f"bench env: seconds = {seconds}: must be above 0")
    if part.library is None:
        measured = _measure_with_resets(part, batch, seconds)
    else:
        measured = _measure_simulations(part, part.library, batch, seconds)
    return {"problem": problem, "batch": batch, "seconds": seconds, **measured}


def _measure_with_resets(part: Benchmarks, batch: int, seconds: float) -> dict[str, float]:
    rng = np.random.default_rng(0)
    env = registry.batch(part.rows(rng, batch))
    actions = rng.integers(0, env.spec.actions, size=(env.spec.horizon, batch))
    fixed = _seeded(0, batch)

    def episode(rngs: Callable[[], Sequence[np.random.Generator]]) -> float:
        began = time.perf_counter()
        env.reset(rngs())
        for row in actions:
            env.step(row)
        return time.perf_counter() - began

    episode(lambda: fixed)  # warms the caches
    unseeded: list[float] = []
    seeded: list[float] = []
    end = time.perf_counter() + seconds
    while not seeded or time.perf_counter() < end:
        # They alternate, so that other load on the machine slows both equally.
        unseeded += [episode(lambda: fixed) for _ in range(3)]
        seeded.append(episode(partial(_seeded, len(seeded), batch)))
    return {
        "steps_per_s": actions.size * len(unseeded) / sum(unseeded),
        "seeded_steps_per_s": actions.size * len(seeded) / sum(seeded),
    }


def _seeded(episode: int, batch: int) -> list[np.random.Generator]:
    return [np.random.default_rng(np.random.SeedSequence(0, spawn_key=(episode, row))) for row in range(batch)]


def _measure_simulations(part: Benchmarks, library_env: Library, batch: int, seconds: float) -> dict[str, float]:
    import mujoco

    rng = np.random.default_rng(0)
    rows = part.rows(rng, batch)
    ours = registry.batch(rows)
    theirs = [library_env(row) for row in rows]
    actions = rng.uniform(-1, 1, (ours.spec.horizon, batch, ours.spec.actions)).astype(np.float32)

    def batched() -> None:
        for row in actions:
            ours.step(row)

    def library() -> None:
        for row in actions:
            for env, action in zip(theirs, row, strict=True):
                env.step(action)

    def physics_only() -> None:
        for row in actions:
            for env, action in zip(theirs, row, strict=True):
                env.data.ctrl[:] = action[: len(env.data.ctrl)]
                mujoco.mj_step(env.model, env.data, env.substeps)

    took: dict[str, list[float]] = {"ours": [], "plain": [], "mj_step": []}
    end = time.perf_counter() + seconds
    while not took["ours"] or time.perf_counter() < end:
        for name, loop in (("ours", batched), ("plain", library), ("mj_step", physics_only)):
            if name == "ours":
                ours.reset(_seeded(len(took[name]), batch))
            else:
                for env in theirs:
                    env.reset()
            began = time.process_time()
            loop()
            took[name].append(time.process_time() - began)
    # Medians, because other load on the machine slows only some of the rounds.
    steps = {name: actions.shape[0] * batch / float(np.median(times)) for name, times in took.items()}
    return {
        "steps_per_s": steps["ours"],
        "plain_steps_per_s": steps["plain"],
        "mj_step_steps_per_s": steps["mj_step"],
        "ratio": steps["ours"] / steps["plain"],
        "limit_ratio": steps["ours"] / steps["mj_step"],
    }


def describe(result: dict[str, Any]) -> str:
    """The result in one line of text."""
    if "ratio" in result:
        return (
            f"{result['problem']}: {result['steps_per_s']:,.0f} control steps/s of {result['batch']} disturbed variations on "
            f"one core, {result['ratio']:.2f} times a loop over its library's environments, "
            f"{result['limit_ratio']:.2f} of mj_step alone"
        )
    return (
        f"{result['problem']}: {result['steps_per_s'] / 1e6:.1f} million steps/s in batches of {result['batch']:,} "
        f"on one core, {result['seeded_steps_per_s'] / 1e6:.1f} with a new generator for every row and episode"
    )
