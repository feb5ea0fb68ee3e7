"""Base class of DeepMind Control and Meta-World: vector actions, network adversaries, SAC experts."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.config.toml import ConfigError
from icrl_dist.experts.payloads import ExpertHistories, ExpertLabelling
from icrl_dist.interfaces import Batch, Contexts, LearningHistories, Limits, MakePolicy, Policy, Problem, Reference
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.continuous.network_adversary import network, networks
from icrl_dist.rollout.policies import RandomVectorPolicy
from icrl_dist.types import Adversary, Variation

if TYPE_CHECKING:
    from icrl_dist.config.run import Run

EXPERT, SCRIPTED = "expert", "scripted"
"""Keys of reference agents: experts trained in the undisturbed tasks, and a scripted policy of the true states."""


class ContinuousProblem(Problem):
    """A simulated problem with vector actions; the adversary is a network whose input is the observation."""

    section = "control"
    Config = ControlConfig
    Labelling = ExpertLabelling
    free_in_forks = ("strength", "solved")
    agent_names: ClassVar[Mapping[str, str]] = {
        EXPERT: "SAC expert",
        SCRIPTED: "scripted expert",
        "rarl": "RARL",
        "qarl": "QARL",
    }
    rewards: ClassVar[tuple[float, float]] = (0.0, 1.0)
    """Smallest and largest reward of a step."""
    config: ControlConfig

    @property
    @abc.abstractmethod
    def disturbances(self) -> int:
        """Components of the adversary's action."""

    @property
    def limits(self) -> Limits:
        """Simulated velocities and forces exceed the usual range that the spec states."""
        return Limits(self.rewards, slack=100.0, disturbances=self.disturbances)

    @property
    def strength(self) -> float:
        """Strength of a training adversary, as a number; see ``control.strength``."""
        return calibrated_strength.strength(self.config, self.name)

    @property
    def train_count(self) -> int:
        return self.config.train_tasks

    @property
    def evaluated_count(self) -> int:
        return self.config.test_tasks

    def training_adversaries(self, rng: np.random.Generator, config: AdversaryConfig) -> tuple[Adversary, ...]:
        return networks(rng, config.count, self.spec, self.disturbances, self.strength)

    def test_adversary(self, rng: np.random.Generator, strength: float, prior: str) -> Adversary:
        """A network with another seed and ``strength`` times ``control.strength``; ``prior`` has no effect."""
        return network(int(rng.integers(2**31)), self.spec.observation, self.disturbances, strength * self.strength)

    def labelling(self, run: Run) -> ExpertLabelling:
        of = run.pretrain
        return ExpertLabelling(
            queries=of.queries, window=run.model.window, windows=of.windows, decoy_fraction=of.decoy_fraction
        )

    def contexts(self, run: Run) -> Contexts:
        """Histories of SAC experts, with at most the episodes of their training."""
        most_trials = max(1, run.sac.steps // self.horizon)
        return Contexts(ExpertHistories(run.sac, self.labelling(run)), most_trials)

    def learning_histories(self, run: Run, trials: int) -> LearningHistories | None:
        """The histories of SAC experts; None where contexts are not theirs."""
        found = self.contexts(run)
        if not isinstance(found.payload, ExpertHistories):
            return None
        return LearningHistories(found.payload, trials if found.most_trials is None else min(trials, found.most_trials))

    def references(self, run: Run) -> dict[str, Reference]:
        return {"random": Reference(_random)}

    @classmethod
    def translated(cls, tables: dict[str, Any]) -> dict[str, Any]:
        """Version 0.1.0 wrote ``bite:SHARE`` for ``drop:SHARE``, and the seed of every split into Dark Room's section."""
        section, room = tables.get(cls.section, {}), tables.get("darkroom", {})
        if not isinstance(section, dict) or not isinstance(room, dict):
            return tables
        shared = {"split_seed": room["split_seed"]} if "split_seed" in room else {}
        texts = {name: section[name] for name in ("strength", "solved") if isinstance(section.get(name), str)}
        renamed = {name: text.replace("bite:", "drop:") for name, text in texts.items()}
        return {**tables, cls.section: {**shared, **section, **renamed}}

    def resolved(self) -> ControlConfig:
        return calibrated_strength.resolved(self.config, self.name)

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        of, count = self.config, self.config.train_tasks
        if isinstance(of.strength, str):
            try:
                calibrated_strength.share(of.strength)
            except ConfigError:
                yield (
                    "control.strength",
                    of.strength,
                    "write a number, or drop:SHARE, as in drop:0.25, where SHARE, above 0 and below 1, is the share of its "
                    "return that the undisturbed expert loses",
                )
        yield from self._own_objections(run)
        single_task_job = count == 1 or count % run.stream.job_tasks == 1 or run.stream.job_tasks == 1
        if run.pretrain.windows and run.pretrain.decoy_fraction and single_task_job:
            tasks = next((tasks for tasks in range(2, count + 1) if count % tasks != 1), 0)
            other = f"stream.job_tasks = {tasks}" if tasks else "control.train_tasks = 2"
            reason = "decoys need the expert of a second task in the same job"
            yield "pretrain.decoy_fraction", run.pretrain.decoy_fraction, f"use 0, or {other}: {reason}"

    @abc.abstractmethod
    def _own_objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        """The values that this problem's simulator does not allow."""

    def manifest(self) -> dict[str, Any]:
        return {"split_seed": self.config.split_seed, **super().manifest()}


def _random(rows: Sequence[Variation], env: Batch) -> Policy:
    return RandomVectorPolicy()


def experts_of(problem: Problem, run: Run) -> MakePolicy | None:
    """The SAC experts of the undisturbed evaluated tasks; None unless all of them are in the cache of this node."""
    from icrl_dist.experts import cache
    from icrl_dist.experts.train import ExpertPolicy

    stored = {task: cache.load_any(Variation(task), problem.horizon, run.sac, run.seed) for task in problem.evaluated}
    found = {task: history for task, history in stored.items() if history is not None}
    if len(found) < len(stored):
        return None
    return lambda rows, env: ExpertPolicy([found[row.task] for row in rows], run.sac)


def missing_experts(problem: Problem, run: Run, what: str) -> str:
    """Why tables show no expert, and the command that trains the missing ones; empty if all are in the cache."""
    from icrl_dist.experts import cache

    if not run.sac.cache:
        return "tables show no SAC expert: with sac.cache = '' experts are not stored; set it"
    missing = [
        task for task in problem.evaluated if cache.load_any(Variation(task), problem.horizon, run.sac, run.seed) is None
    ]
    if not missing:
        return ""
    where = f"{len(missing)} of the evaluated tasks have none in {run.sac.cache} on this node"
    train = f"icrl-dist train experts-{what} --out OTHER"
    return f"tables show no SAC expert: {where}; `{train}` trains them"
