"""Labels of Dark Room: query states and action windows for any trajectory, with exact labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Gt, Le
from jaxtyping import Float32, Int, Int16

from icrl_dist.config.ranges import NotNegative, NotNegativeFloat, Positive, Probability, Share
from icrl_dist.interfaces import LabelledQueries
from icrl_dist.models.sampling import sample
from icrl_dist.problems.darkroom.exact_agents import OptimalAgent
from icrl_dist.problems.darkroom.room import DarkRoom, cells
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, heuristic_labels, robust_labels, soft_labels
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Identity, Job, LabelCounts, Variation


@dataclass(frozen=True)
class RoomLabelling:
    """Settings by which a job labels query states in rooms."""

    labels: Literal["soft", "sampled", "heuristic"]
    """As ``DarkRoomConfig.labels``."""
    gamma: Annotated[float, Gt(0), Le(1)]
    slack: NotNegativeFloat
    """As ``DarkRoomConfig.label_slack``."""
    queries: Positive
    """Query states per trajectory."""
    window: Positive
    """States per action window."""
    windows: NotNegative
    """Action windows per trajectory."""
    decoy_fraction: Share
    """Share of the windows in which the optimal policy of another goal acts."""
    decoys: tuple[int, ...]
    """Cell numbers of the goals that decoys may have."""
    undisturbed: bool = False
    """Whether the labels are those of the task without its adversary, pi*_{tau,phi_0}."""
    worst_p: Probability | None = None
    """If given, the labels are those of pi^rb_tau: of the policy that is best against the worst override of this p."""

    @property
    def label_counts(self) -> LabelCounts:
        """The labels of each trajectory."""
        steps = self.windows * self.window
        return LabelCounts(self.queries + steps, steps, "heuristic" if self.labels == "heuristic" else "optimal")


NO_WINDOWS = np.zeros(0, np.int16), np.zeros(0, np.float32)
"""``prev_actions`` and ``prev_rewards`` without action windows."""


def labels_of(hypotheses: Hypotheses, labels: str, gamma: float, slack: float) -> Float32[np.ndarray, "M C A"]:
    """The labels of every hypothesis in every cell: pi*_{tau,phi} (eq. 5), or the paper's heuristic."""
    return heuristic_labels(hypotheses) if labels == "heuristic" else soft_labels(hypotheses, gamma, slack)


class RoomLabeller:
    """Draws query states and action windows of each trajectory's variation, from random states, and labels them."""

    def __init__(self, job: Job, labelling: RoomLabelling) -> None:
        self._job, self._labelling = job, labelling
        hypotheses = Hypotheses.of([Variation(v.task) for v in job.variations] if labelling.undisturbed else job.variations)
        self._size, self._cells = hypotheses.size, cells(hypotheses.size)
        self._row = {place: row for row, place in enumerate(job.rows())}
        if labelling.worst_p is None:
            self._table = labels_of(hypotheses, labelling.labels, labelling.gamma, labelling.slack)
        else:
            self._table = robust_labels(hypotheses, labelling.worst_p, labelling.gamma, labelling.slack)
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
        single = [self._queries(row, rng) for row, rng in zip(rows.tolist(), rngs, strict=True)]
        if not self._labelling.windows:
            return single
        states, prev_actions, prev_rewards = self._windows(rows, rngs)
        labels = self._table[rows[:, None], cell_numbers(states, self._size)]
        if self._labelling.labels == "sampled":
            u = np.stack([rng.random(labels.shape[1]) for rng in rngs])
            labels = np.stack([_one_hot(*row) for row in zip(labels, u, strict=True)])
        return [
            LabelledQueries(
                np.concatenate([one.queries, states[b]]),
                np.concatenate([one.labels, labels[b]]),
                prev_actions[b],
                prev_rewards[b],
                one.origin,
            )
            for b, one in enumerate(single)
        ]

    def _queries(self, row: int, rng: np.random.Generator) -> LabelledQueries:
        """Query states of one variation that belong to no window, with labels."""
        query = rng.integers(0, len(self._cells), size=self._labelling.queries)
        labels = self._table[row, query]
        if self._labelling.labels == "sampled":
            labels = _one_hot(labels, rng.random(len(query)))
        origin = "heuristic" if self._labelling.labels == "heuristic" else "optimal"
        return LabelledQueries(self._cells[query], labels, *NO_WINDOWS, origin)

    def _windows(
        self, row: Int[np.ndarray, " B"], rngs: Sequence[np.random.Generator]
    ) -> tuple[Float32[np.ndarray, "B R S"], Int16[np.ndarray, "B R"], Float32[np.ndarray, "B R"]]:
        """States, actions and rewards of each trajectory's action windows, one after another; each starts in a random state.

        The policy of the labels acts, or in a decoy the optimal policy of another goal.  ``row``: the
        trajectories' rows of ``Job.variations``.
        """
        of = self._labelling
        drawn = [(rng.random(of.windows), rng.integers(0, len(self._decoys), size=of.windows)) for rng in rngs]
        u, decoy = (np.concatenate(column) for column in zip(*drawn, strict=True))
        repeated_row = row.repeat(of.windows)
        policy = np.where((u < of.decoy_fraction)[:, None, None], self._decoys[decoy], self._table[repeated_row])
        variations = [self._job.variations[r] for r in repeated_row.tolist()]
        short = [Variation(v.task.replace(start="random", horizon=of.window), v.adversary) for v in variations]
        repeated_rng = [rng for rng in rngs for _ in range(of.windows)]
        ran = episode(DarkRoom(short), OptimalAgent(policy, self._size), repeated_rng)
        states = ran.observations[:, :-1].reshape(len(row), of.windows * of.window, -1)
        return states, ran.actions.reshape(len(row), -1), ran.rewards.reshape(len(row), -1)


def _one_hot(labels: Float32[np.ndarray, "Q A"], u: np.ndarray) -> Float32[np.ndarray, "Q A"]:
    """One action drawn from each label."""
    result: Float32[np.ndarray, "Q A"] = np.eye(labels.shape[1], dtype=np.float32)[sample(labels, u)]
    return result
