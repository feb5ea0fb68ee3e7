"""Parts of benchmarks of a problem of the DeepMind Control Suite."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import cache
from icrl_dist.experts.cache import History
from icrl_dist.experts.payloads import ExpertHistories, ExpertLabelling
from icrl_dist.experts.train import ExpertPolicy, train_expert
from icrl_dist.interfaces import Problem
from icrl_dist.problems.benchmarks import Benchmarks, LibraryEnv
from icrl_dist.problems.continuous.disturbance import DisturbanceExperts, Make, Report, Setting
from icrl_dist.problems.continuous.network_adversary import network
from icrl_dist.problems.dmc import domains
from icrl_dist.types import Job, Task, Variation

COMPETENT = ("dmc-cartpole-balance",)
"""Problems whose experts are known to be competent with the settings of the laptop run file."""
LONGER = dict.fromkeys(("dmc-cheetah-run", "dmc-reacher-easy", "dmc-reacher-hard"), 36_000)
"""Training steps for problems whose experts have almost no return after the 12,000 steps of the run file."""


def benchmarks(problem: Problem) -> Benchmarks:
    """The parts of benchmarks of this problem."""
    kind = problem.name

    def rows(rng: np.random.Generator, batch: int) -> list[Variation]:
        """The pretraining tasks in turn, with a separate network adversary in every row."""
        tasks = domains.grid(kind, 4)
        inputs, outputs = domains.spec(tasks[0]).observation, domains.problem(kind).forces["paper"].count
        seeds = rng.integers(2**31, size=batch).tolist()
        return [Variation(tasks[row % len(tasks)], network(seed, inputs, outputs)) for row, seed in enumerate(seeds)]

    return Benchmarks(rows, 20, lambda row: _dm_control(kind), SACExperts(problem))


def _dm_control(kind: str) -> LibraryEnv:
    from icrl_dist.problems.dmc.simulation import suite_environment

    env = suite_environment(kind)

    def step(action: np.ndarray) -> object:
        return np.concatenate([np.ravel(part) for part in env.step(action).observation.values()])

    substeps = round(env.control_timestep() / env.physics.timestep())
    return LibraryEnv(env.reset, step, env.physics.model.ptr, env.physics.data.ptr, substeps)


class SACExperts(DisturbanceExperts):
    """Undisturbed SAC experts: of the nominal task, and of the central 2x2 of the grid to calibrate strengths."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._kind = problem, problem.name
        self.run_file = f"{problem.name}-laptop"
        self.steps = LONGER.get(problem.name, 0)
        self.competent = problem.name in COMPETENT

    def settings(self) -> list[Setting]:
        """Both presets of forces if they differ, else one."""
        forces = domains.problem(self._kind).forces
        presets = ("paper",) if forces["paper"] == forces["qarl"] else ("paper", "qarl")
        return [Setting(name, domains.task(self._kind, forces=name), forces[name].count) for name in presets]  # type: ignore[index]

    def tasks(self, setting: Setting, count: int) -> tuple[Task, ...]:
        """The nominal task."""
        return (setting.task,)

    def policy(self, config: SACConfig, report: Report) -> Make:
        _require_cache(config)
        variation = Variation(domains.task(self._kind))
        found = self._kept(variation, config)
        if found is None:
            report(f"{self._kind}: training an expert for {config.steps:,} steps")
            found = next(iter(self._trained((variation,), config, report)), None)
        if found is None:
            raise ConfigError(f"sac.cache = {config.cache!r}: the trained expert is not there; set it to a writable folder")
        history = found
        return lambda env: ExpertPolicy([history] * env.batch, config)

    def calibration_tasks(self, setting: Setting, count: int) -> tuple[Task, ...]:
        """The tasks of the smallest training set."""
        return tuple(task.replace(forces=setting.forces) for task in domains.grid(self._kind, 2))

    def calibration_policy(self, config: SACConfig, report: Report) -> Make:
        _require_cache(config)
        variations = tuple(Variation(task) for task in domains.grid(self._kind, 2))
        found = self._trained(variations, config, report)
        if len(found) < len(variations):
            raise ConfigError(f"sac.cache = {config.cache!r}: the trained experts are not there; set it to a writable folder")
        return lambda env: ExpertPolicy([history for history in found for _ in range(env.batch // len(found))], config)

    def describe(self, setting: Setting, config: SACConfig) -> dict[str, Any]:
        newtons = domains.problem(self._kind).forces[setting.forces].largest  # type: ignore[index]
        return {"forces": setting.forces, "newtons": newtons, "steps": config.steps}

    def calibration_key(self, setting: Setting) -> dict[str, Any]:
        presets = ["paper", "qarl"] if len(self.settings()) == 1 else [setting.forces]
        return {"forces": presets, "meters": 0.0}

    def expert(self, config: SACConfig) -> str:
        return f"SAC, {config.steps:,} steps, {'-'.join(map(str, config.hidden))}"

    def _kept(self, variation: Variation, config: SACConfig) -> History | None:
        return cache.load_any(variation, domains.spec(variation.task).horizon, config, 0)

    def _trained(self, variations: tuple[Variation, ...], config: SACConfig, report: Report) -> list[History]:
        """Undisturbed experts, one per variation, from the cache or newly trained; without a cache they are missing."""
        messages = itertools.count(1)

        def progress(text: str, note: bool = False, reached: int = 0) -> None:
            if note or next(messages) % 10 == 0:
                report(f"{self._kind}: {text}")

        payload = ExpertHistories(config, ExpertLabelling(queries=1, window=1, windows=0, decoy_fraction=0.0))
        job = Job(payload.kind, "pretrain", 0, 0, variations, 1, -1, 0, payload, len(variations))
        for _ in train_expert(job, self._problem, "bench", progress):
            pass  # the trajectories are not needed: the histories are read from the cache
        return [history for variation in variations if (history := self._kept(variation, config)) is not None]


def _require_cache(config: SACConfig) -> None:
    """Raises ConfigError before a training whose expert is read from the cache, if there is none."""
    reason = "" if config.cache else "sac.cache = '': the expert is read from there: set it to a writable folder"
    if reason := reason or cache.unusable(config):
        raise ConfigError(reason)
