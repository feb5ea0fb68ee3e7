"""Trajectories for timing the parts of a run: from its own jobs if these are fast, else random ones of the same shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from icrl_dist.methods.recipes import Key
from icrl_dist.problems import registry
from icrl_dist.results import evaluate
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Job, Trajectory


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


def random_trajectories(job: Job) -> list[Trajectory]:
    """Trajectories with the job's shapes, and random actions and labels: costs do not depend on the content."""
    rng, trajectories = np.random.default_rng(0), []
    rows = job.rows()[: max(2, job.tasks)]
    chosen = list(job.variations[: len(rows)])
    ran = episode(registry.batch(chosen), evaluate.random_vectors(chosen), [np.random.default_rng(r) for r in range(len(rows))])
    queries, windows, length = (int(str(job.setting(name))) for name in ("queries", "windows", "window"))
    count, actions = queries + windows * length, ran.actions.shape[-1]
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
                    taken=np.zeros((windows * length, actions), np.float32),
                    gained=np.zeros(windows * length, np.float32),
                    origin="expert",
                )
            )
    return trajectories


class Sample:
    """Trajectories of timed jobs in the form of a method's dataset."""

    def __init__(self, stages: dict[str, list[Trajectory]]) -> None:
        self._trials: dict[Key, list[Trajectory]] = {}
        for stage, trajectories in stages.items():
            for trajectory in trajectories:
                key = (stage, 0, trajectory.identity.task, trajectory.identity.variation)
                self._trials.setdefault(key, []).append(trajectory)

    def variations(self, stage: str, round: int) -> Sequence[Key]:
        return [key for key in self._trials if key[0] == stage and round == 0]

    def trials(self, key: Key) -> list[Trajectory]:
        return self._trials[key]
