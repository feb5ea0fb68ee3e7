"""Steps per second of variation environments: one process, one core, an adversary in every row."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.network_adversary import network
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.darkroom.adversaries import sample_dirichlet
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import Task, Variation

_BATCH = {"darkroom": 1024}
_SIMULATION_BATCH = 20


def _darkroom(rng: np.random.Generator, batch: int) -> list[Variation]:
    """A 10x10 room with a random goal and a separate Dirichlet adversary (p > 0) in every row."""
    goals = rng.integers(0, 10, size=(batch, 2)).tolist()
    return [Variation(room.task(goal), sample_dirichlet(rng, room.ACTIONS, 0.2)) for goal in goals]


def _dmc(kind: str, rng: np.random.Generator, batch: int) -> list[Variation]:
    """The pretraining tasks in turn, with a separate network adversary in every row."""
    tasks = domains.grid(kind, 4)
    inputs, outputs = registry.spec(tasks[0]).observation, domains.problem(kind).forces["paper"].count
    seeds = rng.integers(2**31, size=batch).tolist()
    return [Variation(tasks[row % len(tasks)], network(seed, inputs, outputs)) for row, seed in enumerate(seeds)]


def run(problem: str = "darkroom", batch: int | None = None, seconds: float = 3.0) -> dict[str, Any]:
    """Step whole episodes of random actions for about ``seconds``.

    ``steps_per_s`` includes resets only in Dark Room.  Actions are drawn beforehand, because choosing
    them is the agent's work.  In Dark Room ``seeded_steps_per_s`` also creates each row's generator from
    an identity at every reset, as the jobs of a run do.  In DeepMind Control and Meta-World ``ratio`` is
    our steps/s divided by those of a loop over the library's own environments, and ``limit_ratio`` divided
    by those of MuJoCo's ``mj_step`` alone; the three alternate.  Raises ConfigError for an unknown problem
    and for a batch or a time that is not above 0.
    """
    if problem not in registry.KINDS:
        known = ", ".join(sorted(registry.KINDS))
        raise ConfigError(f"bench env: problem = {problem!r}{nearest(problem, registry.KINDS)}: choose one of {known}")
    batch = _BATCH.get(problem, _SIMULATION_BATCH) if batch is None else batch
    if batch < 1:
        raise ConfigError(f"bench env: batch = {batch}: must be above 0")
    if not seconds > 0:
        raise ConfigError(f"bench env: seconds = {seconds}: must be above 0")
    measure = _measure_rooms if problem == "darkroom" else partial(_measure_simulations, problem)
    return {"problem": problem, "batch": batch, "seconds": seconds, **measure(batch, seconds)}


def _measure_rooms(batch: int, seconds: float) -> dict[str, float]:
    rng = np.random.default_rng(0)
    env = registry.batch(_darkroom(rng, batch))
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


class _LibraryEnv(NamedTuple):
    """One environment of the library that a problem comes from."""

    reset: Callable[[], object]
    step: Callable[[np.ndarray], object]
    model: Any
    data: Any
    substeps: int


def _dm_control(kind: str) -> _LibraryEnv:
    from icrl_dist.problems.dmc.simulation import suite_environment

    env = suite_environment(kind)

    def step(action: np.ndarray) -> object:
        return np.concatenate([np.ravel(part) for part in env.step(action).observation.values()])

    substeps = round(env.control_timestep() / env.physics.timestep())
    return _LibraryEnv(env.reset, step, env.physics.model.ptr, env.physics.data.ptr, substeps)


def _meta_world(task: Task) -> _LibraryEnv:
    from icrl_dist.problems.metaworld.environment import environment

    env = environment(task)
    return _LibraryEnv(env.reset, env.step, env.model, env.data, env.frame_skip)


def _meta_world_rows(rng: np.random.Generator, batch: int) -> list[Variation]:
    """Random objects and goals in Meta-World's box, with a separate network adversary in every row."""
    places = rng.uniform((-0.1, 0.6, 0.02, -0.1, 0.8, 0.05), (0.1, 0.7, 0.02, 0.1, 0.9, 0.3), (batch, 6)).tolist()
    seeds = rng.integers(2**31, size=batch).tolist()
    adversaries = [network(seed, 39, pick_place.MOVED) for seed in seeds]
    return [Variation(pick_place.task(p[:3], p[3:]), a) for p, a in zip(places, adversaries, strict=True)]


def _measure_simulations(kind: str, batch: int, seconds: float) -> dict[str, float]:
    import mujoco

    rng = np.random.default_rng(0)
    rows = _meta_world_rows(rng, batch) if kind == pick_place.KIND else _dmc(kind, rng, batch)
    ours = registry.batch(rows)
    theirs = [_meta_world(row.task) if kind == pick_place.KIND else _dm_control(kind) for row in rows]
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
