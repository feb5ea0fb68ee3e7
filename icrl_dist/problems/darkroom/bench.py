"""Parts of benchmarks of Dark Room: disturbed rooms, and DPT's pretraining distribution with its exact posterior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int

from icrl_dist.problems.benchmarks import Benchmarks
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.darkroom.adversaries import SYMMETRIES, sample_dirichlet
from icrl_dist.problems.darkroom.room import cells, next_cell
from icrl_dist.problems.darkroom.solver import (
    Hypotheses,
    expected_returns,
    heuristic_labels,
    log_likelihood,
    optimal_returns,
    posterior,
    posterior_action,
    soft_labels,
)
from icrl_dist.training.batches import TrainingBatch
from icrl_dist.types import NULL, Adversary, Variation


def benchmarks() -> Benchmarks:
    """The parts of benchmarks of this problem."""
    return Benchmarks(_rows, 1024, kept=kept, pretraining=DPTData)


def _rows(rng: np.random.Generator, batch: int) -> list[Variation]:
    """A 10x10 room with a random goal and a separate Dirichlet adversary (p > 0) in every row."""
    goals = rng.integers(0, 10, size=(batch, 2)).tolist()
    return [Variation(room.task(goal), sample_dirichlet(rng, room.ACTIONS, 0.2)) for goal in goals]


def kept(disturbance: str, size: int, horizon: int, p: float) -> float:
    """Share of the optimum that the undisturbed optimal policy keeps, in the mean over all goals, from the origin.

    Ties between its actions are broken at random.  The adversaries are the uniform override, every direction of the
    wind, or every symmetry of the square.
    """
    adversaries = {
        "override": [Adversary.of("uniform", p=p)],
        "wind": [Adversary.of("wind", p=p, direction=direction) for direction in range(4)],
        "permuted": [Adversary.of("permuted", p=p, permutation=one) for one in SYMMETRIES],
    }[disturbance]
    goals = [room.task(divmod(cell, size), size, horizon, (0, 0)) for cell in range(size**2)]
    policy = soft_labels(Hypotheses.of([Variation(goal) for goal in goals]), 0.99, 1e-9)
    disturbed = [[Variation(goal, adversary) for goal in goals] for adversary in adversaries]
    earned = sum(expected_returns(policy, variations).sum() for variations in disturbed)
    return float(earned / sum(optimal_returns(Hypotheses.of(variations)).sum() for variations in disturbed))


@dataclass(frozen=True, eq=False)
class DPTContexts:
    """B contexts with N queries each."""

    goal: Int[np.ndarray, " B"]
    cell: Int[np.ndarray, "B T"]
    action: Int[np.ndarray, "B T"]
    arrived: Int[np.ndarray, "B T"]
    reward: Float32[np.ndarray, "B T"]
    query: Int[np.ndarray, "B N"]
    label: Float32[np.ndarray, "B N A"]
    coordinates: Float32[np.ndarray, "C 2"]
    """Observation in each cell."""

    def batch(self, prefix: Int[np.ndarray, "B N"]) -> TrainingBatch:
        """As a training batch in which each query sees this many transitions."""
        states, arrived, queries = (self.coordinates[c] for c in (self.cell, self.arrived, self.query))
        return TrainingBatch(states, self.action, arrived, self.reward, queries, self.label, prefix)


class DPTData:
    """DPT's data distribution with the goals of a seed.

    A room without disturbance, one of ``goals`` goals, a context of ``length`` transitions with uniform states
    and actions, a uniform query cell, and its optimal action as the label (first y, then x: appendix C.1).
    """

    def __init__(self, seed: int, size: int, length: int, goals: int) -> None:
        self._seed, self._size, self._length, self._goals = seed, size, length, goals
        self.spec = room.spec(room.task((0, 0), size, length))
        chosen = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,))).permutation(size**2)[:goals]
        rooms = [room.task(divmod(int(goal), size), size, length) for goal in chosen]
        self.hypotheses = Hypotheses.of([Variation(one, NULL) for one in rooms])
        self.labels = heuristic_labels(self.hypotheses)
        self._next, self._coordinates = next_cell(size), cells(size)

    def draw(self, stream: int, step: int, batch: int, queries: int) -> DPTContexts:
        """Batch number ``step`` of a stream of batches; equal arguments give equal batches."""
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(1, stream, step)))
        index = rng.integers(0, self._goals, size=batch)
        goal = self.hypotheses.goal[index]
        cell = rng.integers(0, self._size**2, size=(batch, self._length))
        action = rng.integers(0, self.spec.actions, size=(batch, self._length))
        query = rng.integers(0, self._size**2, size=(batch, queries))
        arrived = self._next[cell, action]
        reward = (arrived == goal[:, None]).astype(np.float32)
        label = self.labels[index[:, None], query]
        return DPTContexts(goal, cell, action, arrived, reward, query, label, self._coordinates)

    def floor(self, contexts: DPTContexts) -> float:
        """Cross-entropy of the exact posterior's decisions after 1 to T transitions, at the first query of each context."""
        prior = np.full(self._goals, -np.log(self._goals))
        total: list[Float64[np.ndarray, " T"]] = []
        for row, (query, label) in enumerate(zip(contexts.query[:, 0], contexts.label[:, 0], strict=True)):
            columns = (contexts.cell[row], contexts.action[row], contexts.reward[row], contexts.arrived[row])
            weights = posterior(prior, log_likelihood(self.hypotheses, *columns).cumsum(axis=0))
            probs = posterior_action(weights, self.labels, np.full(self._length, query))
            total.append(-np.log((probs * label).sum(axis=1)))
        return float(np.mean(total))
