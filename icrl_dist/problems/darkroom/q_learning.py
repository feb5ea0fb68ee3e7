"""Histories of tabular Q-learning, which Algorithm Distillation learns from (Laskin et al. 2022).

Rewards are sparse, so a table of zeros would give an agent that walks at random until it meets the goal.  Optimistic
first values make it try every action everywhere first (Sutton and Barto, section 2.6).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from icrl_dist.collect.trajectories import trajectory, unlabelled
from icrl_dist.config.q_learning import QLearning
from icrl_dist.config.ranges import Positive
from icrl_dist.interfaces import Problem, Progress
from icrl_dist.problems.darkroom.solver import cell_numbers
from icrl_dist.rollout.episode import episode
from icrl_dist.rollout.policies import DiscretePolicy
from icrl_dist.types import Identity, Job, LabelCounts, Payload, Trajectory


@dataclass(frozen=True)
class QLearningHistories(Payload):
    """Histories of Q-learning: trial n of a variation is the next episode of the agent that learned in trial n - 1."""

    kind: ClassVar[str] = "q_learning"
    learner: QLearning = field(default_factory=QLearning)
    count: Positive = 1
    """Histories of each variation, one after another: see ``LearningHistories.count``."""

    @property
    def labels(self) -> LabelCounts:
        """None: the actions of the histories are the labels."""
        return LabelCounts(0, 0, "none")


class QLearner(DiscretePolicy):
    """Q-learning in each of B rooms.  Of equally good actions each has the same probability."""

    def __init__(self, rows: int, size: int, actions: int, of: QLearning) -> None:
        self._of, self._size = of, size
        self.values: Float64[np.ndarray, "B C A"] = np.full((rows, size * size, actions), float(of.optimism))
        self.begin(0.0)

    def begin(self, progress: float) -> None:
        """Set the rates of the next episode; ``progress``: 0 in the first episode of a history, 1 in the last."""
        of = self._of
        self._epsilon = of.epsilon + (of.epsilon_end - of.epsilon) * progress
        self._step = of.step + (of.step_end - of.step) * progress

    def probabilities(self, observation: Float32[np.ndarray, "B 2"]) -> Float[np.ndarray, "B A"]:
        here = self.values[np.arange(len(observation)), cell_numbers(observation, self._size)]
        best = here == here.max(axis=1, keepdims=True)
        greedy: np.ndarray = best / best.sum(axis=1, keepdims=True)
        return self._epsilon / here.shape[1] + (1 - self._epsilon) * greedy

    def observe(
        self,
        observation: Float32[np.ndarray, "B 2"],
        action: Int64[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B 2"],
        done: bool,
    ) -> None:
        """One update of each room's table.  The end of an episode is a time limit, so the last state has a value too."""
        rows = np.arange(len(action))
        taken = rows, cell_numbers(observation, self._size), action
        after = self.values[rows, cell_numbers(next_observation, self._size)].max(axis=1)
        self.values[taken] += self._step * (reward + self._of.discount * after - self.values[taken])


def q_learning(job: Job, problem: Problem, worker: str, progress: Progress) -> Iterator[Trajectory]:
    """The episodes of all histories, one trial of every variation after the other."""
    payload = job.payload
    assert isinstance(payload, QLearningHistories)
    env = problem.batch(job.variations)
    size = round(env.spec.high[0]) + 1
    for history in range(payload.count):
        begin, end = (job.trials * number // payload.count for number in (history, history + 1))
        learner = QLearner(env.batch, size, env.spec.actions, payload.learner)
        for trial in range(begin, end):
            learner.begin((trial - begin) / max(1, end - begin - 1))
            row = [Identity(job.stage, job.round, i, k, trial) for i, k in job.rows()]
            ran = episode(env, learner, [identity.rng(job.seed) for identity in row])
            for b, identity in enumerate(row):
                yield trajectory(job, identity, ran, b, worker, "", unlabelled(env.spec))
