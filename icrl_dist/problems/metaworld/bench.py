"""Parts of benchmarks of Meta-World's pick-place."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float32

from icrl_dist.config.sac import SACConfig
from icrl_dist.problems.benchmarks import Benchmarks, LibraryEnv
from icrl_dist.problems.continuous.disturbance import DisturbanceExperts, Make, Report, Setting
from icrl_dist.problems.continuous.network_adversary import network
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import Task, Variation


def benchmarks() -> Benchmarks:
    """The parts of benchmarks of this problem."""
    return Benchmarks(_rows, 20, _meta_world, ScriptedExperts())


def _rows(rng: np.random.Generator, batch: int) -> list[Variation]:
    """Random objects and goals in Meta-World's box, with a separate network adversary in every row."""
    places = rng.uniform((-0.1, 0.6, 0.02, -0.1, 0.8, 0.05), (0.1, 0.7, 0.02, 0.1, 0.9, 0.3), (batch, 6)).tolist()
    seeds = rng.integers(2**31, size=batch).tolist()
    adversaries = [network(seed, 39, pick_place.MOVED) for seed in seeds]
    return [Variation(pick_place.task(p[:3], p[3:]), a) for p, a in zip(places, adversaries, strict=True)]


def _meta_world(row: Variation) -> LibraryEnv:
    from icrl_dist.problems.metaworld.environment import environment

    env = environment(row.task)
    return LibraryEnv(env.reset, env.step, env.model, env.data, env.frame_skip)


class ScriptedExperts(DisturbanceExperts):
    """The scripted policy with the true goal; it observes hand and object as displaced by the adversary."""

    run_file = "metaworld-laptop"
    competent = True
    fixed_starts: ClassVar[bool] = True
    most_reward: ClassVar[float] = 10.0
    remedy: ClassVar[str] = "its scripted policy has failed"

    def settings(self) -> list[Setting]:
        """One displacement."""
        return [Setting("", pick_place.task((0.0, 0.65, 0.02), (0.0, 0.85, 0.2)), pick_place.MOVED)]

    def tasks(self, setting: Setting, count: int) -> tuple[Task, ...]:
        """The first training tasks."""
        from icrl_dist.problems.metaworld.environment import ml1_tasks

        return ml1_tasks(count)

    def policy(self, config: SACConfig, report: Report) -> Make:
        return ScriptedWithGoal

    def calibration_tasks(self, setting: Setting, count: int) -> tuple[Task, ...]:
        return self.tasks(setting, count)

    def calibration_policy(self, config: SACConfig, report: Report) -> Make:
        return ScriptedWithGoal

    def describe(self, setting: Setting, config: SACConfig) -> dict[str, Any]:
        return {"meters": pick_place.disturbance(setting.task)}

    def calibration_key(self, setting: Setting) -> dict[str, Any]:
        return {"forces": [], "meters": pick_place.DISTURBANCE}

    def expert(self, config: SACConfig) -> str:
        return "scripted"


class ScriptedWithGoal:
    """Meta-World's scripted policy, with the observed hand and object and the true goal."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.succeeded: Bool[np.ndarray, " B"] = np.zeros(env.batch, bool)
        """True where the object has reached the goal."""

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """The scripted actions for the observed state and the true goal."""
        from icrl_dist.problems.metaworld.environment import expert as scripted

        state = observation.astype(np.float64)
        state[:, 36:] = self._env.truth[:, 36:]
        return scripted(state)

    def observe(self, *transition: object) -> None:
        """Record successes."""
        self.succeeded = self.succeeded | self._env.success
