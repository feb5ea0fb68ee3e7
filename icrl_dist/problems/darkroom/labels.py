"""Labels of Dark Room: query states and action windows of any history, labelled exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Gt, Le
from jaxtyping import Float32, Int, Int16

from icrl_dist.config.ranges import NotNegative, NotNegativeFloat, Positive, Share
from icrl_dist.interfaces import LabelledQueries
from icrl_dist.models.sampling import sample
from icrl_dist.problems.darkroom.exact_agents import OptimalAgent
from icrl_dist.problems.darkroom.room import DarkRoom, cells
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, heuristic_labels, soft_labels
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Identity, Job, Variation


@dataclass(frozen=True)
class RoomLabelling:
    """What a job needs to label query states in rooms."""

    labels: Literal["soft", "sampled", "heuristic"]
    """As ``DarkRoomConfig.labels``."""
    gamma: Annotated[float, Gt(0), Le(1)]
    slack: NotNegativeFloat
    """As ``DarkRoomConfig.label_slack``."""
    queries: Positive
    """Query states a trajectory."""
    window: Positive
    """States of an action window."""
    windows: NotNegative
    """Action windows a trajectory."""
    decoy_fraction: Share
    """Share of the windows in which the optimal policy of another goal acts."""
    decoys: tuple[int, ...]
    """Cell numbers of the goals that decoys may have."""


NO_WINDOWS = np.zeros(0, np.int16), np.zeros(0, np.float32)
"""Actions and rewards of no action window."""


def labels_of(hypotheses: Hypotheses, labels: str, gamma: float, slack: float) -> Float32[np.ndarray, "M C A"]:
    """pi*_{tau,phi} of every hypothesis as a label in every cell (eq. 5), or the paper's heuristic."""
    return heuristic_labels(hypotheses) if labels == "heuristic" else soft_labels(hypotheses, gamma, slack)


class RoomLabeller:
    """Random query states of each trajectory's variation, and action windows from random states on, with labels."""

    def __init__(self, job: Job, labelling: RoomLabelling) -> None:
        self._job, self._labelling = job, labelling
        hypotheses = Hypotheses.of(job.variations)
        self._size, self._cells = hypotheses.size, cells(hypotheses.size)
        self._row = {place: row for row, place in enumerate(job.rows())}
        self._table = labels_of(hypotheses, labelling.labels, labelling.gamma, labelling.slack)
        if labelling.windows:
            self._decoys = self._undisturbed()

    def _undisturbed(self) -> Float32[np.ndarray, "M C A"]:
        """The optimal policies of the decoys' tasks, without disturbance."""
        task = self._job.variations[0].task
        tasks = [task.replace(goal=divmod(cell, self._size)) for cell in self._labelling.decoys]
        return soft_labels(Hypotheses.of([Variation(one) for one in tasks]), self._labelling.gamma, self._labelling.slack)

    def __call__(self, identities: Sequence[Identity], rngs: Sequence[np.random.Generator]) -> list[LabelledQueries]:
        """The labelled queries of each trajectory, drawn with its own generator."""
        rows = np.array([self._row[identity.task, identity.variation] for identity in identities])
        alone = [self._queries(row, rng) for row, rng in zip(rows.tolist(), rngs, strict=True)]
        if not self._labelling.windows:
            return alone
        states, taken, gained = self._windows(rows, rngs)
        labels = self._table[rows[:, None], cell_numbers(states, self._size)]
        if self._labelling.labels == "sampled":
            u = np.stack([rng.random(labels.shape[1]) for rng in rngs])
            labels = np.stack([_one_hot(*row) for row in zip(labels, u, strict=True)])
        return [
            LabelledQueries(
                np.concatenate([one.queries, states[b]]),
                np.concatenate([one.labels, labels[b]]),
                taken[b],
                gained[b],
                one.origin,
            )
            for b, one in enumerate(alone)
        ]

    def _queries(self, row: int, rng: np.random.Generator) -> LabelledQueries:
        """Single query states of one variation."""
        query = rng.integers(0, len(self._cells), size=self._labelling.queries)
        labels = self._table[row, query]
        if self._labelling.labels == "sampled":
            labels = _one_hot(labels, rng.random(len(query)))
        origin = "heuristic" if self._labelling.labels == "heuristic" else "optimal"
        return LabelledQueries(self._cells[query], labels, *NO_WINDOWS, origin)

    def _windows(
        self, place: Int[np.ndarray, " B"], rngs: Sequence[np.random.Generator]
    ) -> tuple[Float32[np.ndarray, "B R S"], Int16[np.ndarray, "B R"], Float32[np.ndarray, "B R"]]:
        """States, actions and rewards of each row's action windows, one after another, from random states on.

        The labelling policy acts, or in a decoy the optimal policy of another goal.
        """
        of = self._labelling
        drawn = [(rng.random(of.windows), rng.integers(0, len(self._decoys), size=of.windows)) for rng in rngs]
        u, decoy = (np.concatenate(column) for column in zip(*drawn, strict=True))
        rows = place.repeat(of.windows)
        policy = np.where((u < of.decoy_fraction)[:, None, None], self._decoys[decoy], self._table[rows])
        short = [self._job.variations[p] for p in rows.tolist()]
        short = [Variation(v.task.replace(start="random", horizon=of.window), v.adversary) for v in short]
        repeated = [rng for rng in rngs for _ in range(of.windows)]
        ran = episode(DarkRoom(short), OptimalAgent(policy, self._size), repeated)
        states = ran.observations[:, :-1].reshape(len(place), of.windows * of.window, -1)
        return states, ran.actions.reshape(len(place), -1), ran.rewards.reshape(len(place), -1)


def _one_hot(labels: Float32[np.ndarray, "Q A"], u: np.ndarray) -> Float32[np.ndarray, "Q A"]:
    """One action drawn from each label."""
    result: Float32[np.ndarray, "Q A"] = np.eye(labels.shape[1], dtype=np.float32)[sample(labels, u)]
    return result
