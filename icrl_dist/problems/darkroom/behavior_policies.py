"""Behavior policies: who walks through the contexts of pretraining (pi_b of section 2).

None of them knows the goal, so a context says of the task only what its transitions say
(Assumption E.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from icrl_dist.problems.darkroom.room import ACTIONS, MOVES, cells
from icrl_dist.rollout.policies import DiscretePolicy

KINDS = ("random", "persistent", "goals", "sweep")
"""Names of the policies."""

KEEP = (0.65, 0.95)
"""A persistent walk goes on as before with a probability drawn from here, once an episode."""

REST = 0.5
"""A walk that has come to its cell stays a further step with this probability."""

WANDER = 2.5
"""A sweep takes for its next cell one at most so many steps farther than the nearest."""


def towards(here: Float[np.ndarray, "B 2"], target: Float[np.ndarray, "B 2"]) -> Float[np.ndarray, "B A"]:
    """A move nearer to the target, along each axis as often as there is way to go on it; there, stay."""
    gain = np.maximum((target - here) @ MOVES.T, 0.0)
    gain[:, -1] = gain.sum(axis=1) == 0
    result: np.ndarray = gain / gain.sum(axis=1, keepdims=True)
    return result


class Walks(DiscretePolicy):
    """One episode of a behavior policy in each of B rows.

    ``random``: uniform over the actions.  ``persistent``: the last action again, or a random
    one.  ``goals``: to a random cell, some rest there, then to another, so that contexts also
    hold what a good agent's hold.  ``sweep``: from cell to cell that it has not been in, nearer
    ones first, so that contexts also hold a long search without a find.
    """

    def __init__(self, size: int, horizon: int, kinds: Sequence[str], rngs: Sequence[np.random.Generator]) -> None:
        """``kinds`` and ``rngs`` have one entry a row; what is drawn here is apart from what ``rngs`` draw later."""
        rows = len(kinds)
        self._persistent, self._goals, self._sweep = (
            np.array([k == kind for k in kinds]) for kind in ("persistent", "goals", "sweep")
        )
        self._cells = cells(size)
        self._keep = np.zeros(rows)
        self._rest = np.zeros((horizon, rows), bool)
        self._taste = np.zeros((rows, len(self._cells)))
        for row in np.flatnonzero(self._persistent | self._goals | self._sweep).tolist():
            own = rngs[row].spawn(1)[0]
            self._keep[row] = own.uniform(*KEEP)
            self._rest[:, row] = own.random(horizon) < REST
            self._taste[row] = own.random(len(self._cells))
        self._last = np.full(rows, -1)
        self._target = np.full(rows, -1)
        self._done = np.zeros((rows, len(self._cells)), bool)
        self._step = 0

    def probabilities(self, observation: Float32[np.ndarray, "B 2"]) -> Float[np.ndarray, "B A"]:
        rows = np.arange(len(observation))
        chance = np.full((len(rows), ACTIONS), 1.0 / ACTIONS)
        again = self._persistent & (self._last >= 0)
        chance[again] *= (1 - self._keep[again])[:, None]
        chance[rows[again], self._last[again]] += self._keep[again]
        bound = self._goals | self._sweep
        if bound.any():
            self._choose(observation, bound)
            chance[bound] = towards(observation[bound], self._cells[self._target[bound]])
        return chance

    def _choose(self, here: Float32[np.ndarray, "B 2"], bound: Bool[np.ndarray, " B"]) -> None:
        """A next target for the rows that have reached theirs, and rested if they do."""
        rows = np.arange(len(here))
        away = np.abs(self._cells[None] - here[:, None]).sum(axis=2)
        self._done |= self._sweep[:, None] & (away == 0)
        self._done[self._done.all(axis=1)] = False
        there = away[rows, self._target] == 0
        resting = there & self._goals & self._rest[self._step]
        visited = self._sweep & self._done[rows, self._target]
        free = bound & ((self._target < 0) | (there & ~resting) | visited)
        self._done |= self._goals[:, None] & (away == 0) & free[:, None]
        cost = np.where(self._sweep[:, None], away + WANDER * self._taste, self._taste)
        self._target = np.where(free, np.where(self._done, np.inf, cost).argmin(axis=1), self._target)

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int64[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._last = action
        self._step += 1
