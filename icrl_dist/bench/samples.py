"""Trajectories for timing the parts of a run: from its own jobs if these are fast, else random ones of the same shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from icrl_dist.collect import kinds
from icrl_dist.config.run import Run
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.interfaces import Phase, Problem, VariationKey
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.rollout.episode import episode
from icrl_dist.rollout.policies import RandomVectorPolicy
from icrl_dist.types import Job, Trajectory


class RandomWeights:
    """A source of weights with an untrained model: the cost of a decision does not depend on the weights."""

    def __init__(self, model: torch.nn.Module) -> None:
        self._model = model

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        return self._model, "0" * 64


def collected(run: Run, phase: Phase, model: torch.nn.Module) -> list[Trajectory]:
    """The trajectories of the first job of a phase; ``model`` acts where a job needs one."""
    method = methods.of(run)
    return list(kinds.do(method.ask(run, phase)[0], registry.of(run), method, RandomWeights(model), "bench"))


def all_trials(job: Job, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Every trial of the job; missing trials are copies of existing ones."""
    by_variation: dict[tuple[int, int], list[Trajectory]] = {}
    for trajectory in trajectories:
        key = trajectory.identity.task, trajectory.identity.variation
        by_variation.setdefault(key, []).append(trajectory)
    return [
        dataclasses.replace(trials[n % len(trials)], identity=trials[0].identity._replace(trial=n))
        for trials in by_variation.values()
        for n in range(job.trials)
    ]


def random_trajectories(job: Job, problem: Problem) -> list[Trajectory]:
    """Trajectories with the shapes of a job of experts, and random actions and labels: costs do not depend on the content."""
    payload = job.payload
    assert isinstance(payload, ExpertHistories)
    rng, trajectories = np.random.default_rng(0), []
    rows = job.rows()[: max(2, job.tasks)]
    chosen = list(job.variations[: len(rows)])
    ran = episode(problem.batch(chosen), RandomVectorPolicy(), [np.random.default_rng(r) for r in range(len(rows))])
    of = payload.labelling
    labelled = of.windows * of.window
    count, actions = of.queries + labelled, ran.actions.shape[-1]
    for row, (task, variation) in enumerate(rows):
        for trial in range(job.trials):
            trajectories.append(
                Trajectory(
                    identity=next(iter(job.identities()))._replace(task=task, variation=variation, trial=trial),
                    variation=chosen[row],
                    policy_version=job.policy_version,
                    weights_digest="",
                    worker="plan",
                    observations=ran.observations[row],
                    actions=ran.actions[row],
                    rewards=ran.rewards[row],
                    adversary=ran.adversary[row],
                    queries=ran.observations[row][rng.integers(0, len(ran.actions[row]), count)],
                    labels=rng.uniform(-1, 1, (count, actions)).astype(np.float32),
                    prev_actions=np.zeros((labelled, actions), np.float32),
                    prev_rewards=np.zeros(labelled, np.float32),
                    origin="expert",
                )
            )
    return trajectories


class Sample:
    """Trajectories of timed jobs in the form of a method's dataset."""

    def __init__(self, stages: dict[str, list[Trajectory]]) -> None:
        self._trials: dict[VariationKey, list[Trajectory]] = {}
        for stage, trajectories in stages.items():
            for trajectory in trajectories:
                key = (stage, 0, trajectory.identity.task, trajectory.identity.variation)
                self._trials.setdefault(key, []).append(trajectory)

    def variations(self, stage: str, round: int) -> Sequence[VariationKey]:
        return [key for key in self._trials if key[0] == stage and round == 0]

    def trials(self, key: VariationKey) -> list[Trajectory]:
        return self._trials[key]
