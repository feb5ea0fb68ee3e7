"""Training batches of Algorithm Distillation: windows of learning histories, in which every action is a label."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from icrl_dist.training.batches import Examples, ExamplesSequence, TrainingBatch


@dataclass(frozen=True)
class HistoryWindows:
    """Which episodes of a variation form a window."""

    count: int
    """Histories of a variation: see ``LearningHistories.count``."""
    episodes: int
    """Episodes of a window."""
    skip: int
    """A window holds every ``skip``-th episode."""

    @property
    def span(self) -> int:
        """Episodes from the first to the last of a window."""
        return (self.episodes - 1) * self.skip + 1

    def draw(self, rng: np.random.Generator, total: int) -> Int64[np.ndarray, " W"]:
        """The episodes of a random window of a variation with ``total`` episodes; all are of one history."""
        history = int(rng.integers(self.count))
        begin, end = (total * number // self.count for number in (history, history + 1))
        found: np.ndarray = int(rng.integers(begin, end - self.span + 1)) + self.skip * np.arange(self.episodes)
        return found


def draw(
    rng: np.random.Generator, examples: ExamplesSequence, windows: HistoryWindows, batch: int, queries: int
) -> TrainingBatch:
    """A batch of ``batch`` windows of random variations: the context is the window, and query t its state t.

    The prefix of query t is t, so that it is conditioned on what came before it in the window; its label is the action
    that the learning agent took.  ``queries`` of the steps of a window are queries, or all if it has fewer.
    ``examples``: their queries and labels are the states and actions of all episodes, in order.
    """
    rows = [_row(rng, examples[int(i)], windows, queries) for i in rng.integers(0, len(examples), size=batch)]
    columns: list[np.ndarray] = [np.stack(column) for column in zip(*rows, strict=True)]
    observations, actions, next_observations, rewards, states, labels, prefix = columns
    return TrainingBatch(observations, actions, next_observations, rewards, states, labels, prefix)


def _row(rng: np.random.Generator, found: Examples, windows: HistoryWindows, queries: int) -> tuple[np.ndarray, ...]:
    chosen = windows.draw(rng, len(found.actions))
    horizon = found.actions.shape[1]
    length = len(chosen) * horizon
    states = found.observations[chosen]
    step = rng.permutation(length)[:queries]
    query = chosen[step // horizon] * horizon + step % horizon
    return (
        states[:, :-1].reshape(length, -1),
        found.actions[chosen].reshape(length, *found.actions.shape[2:]),
        states[:, 1:].reshape(length, -1),
        found.rewards[chosen].reshape(length),
        found.queries[query],
        found.labels[query],
        step,
    )
