"""Trajectories to time a run's parts with: of its own jobs where those are quick, of their form where they are not."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from icrl_dist.methods.recipes import Key
from icrl_dist.problems import registry
from icrl_dist.results import evaluate
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Job, Trajectory


def in_full(job: Job, made: Sequence[Trajectory]) -> list[Trajectory]:
    """Every trial of the job: those that were not made are repeats of those that were."""
    have: dict[tuple[int, int], list[Trajectory]] = {}
    for one in made:
        have.setdefault((one.identity.task, one.identity.variation), []).append(one)
    return [
        dataclasses.replace(trials[n % len(trials)], identity=trials[0].identity._replace(trial=n))
        for trials in have.values()
        for n in range(job.trials)
    ]


def made_up(job: Job) -> list[Trajectory]:
    """Trajectories of the job's form, of random actions and labels: what they hold costs nothing more or less."""
    rng, made = np.random.default_rng(0), []
    rows = job.rows()[: max(2, job.tasks)]
    chosen = list(job.variations[: len(rows)])
    ran = episode(registry.batch(chosen), evaluate.random_vectors(chosen), [np.random.default_rng(r) for r in range(len(rows))])
    queries, windows, length = (int(str(job.setting(name))) for name in ("queries", "windows", "window"))
    count, actions = queries + windows * length, ran.actions.shape[-1]
    for row, (task, variation) in enumerate(rows):
        for trial in range(job.trials):
            made.append(
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
    return made


class Sample:
    """Timed trajectories as a method's dataset."""

    def __init__(self, stages: dict[str, list[Trajectory]]) -> None:
        self._trials: dict[Key, list[Trajectory]] = {}
        for stage, trajectories in stages.items():
            for one in trajectories:
                self._trials.setdefault((stage, 0, one.identity.task, one.identity.variation), []).append(one)

    def variations(self, stage: str, round: int) -> Sequence[Key]:
        return [key for key in self._trials if key[0] == stage and round == 0]

    def trials(self, key: Key) -> list[Trajectory]:
        return self._trials[key]
