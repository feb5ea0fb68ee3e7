"""Behavior policies: they collect the pretraining contexts (pi_b of section 2).

They do not depend on the goal, so only the transitions of a context carry information about the
task (Assumption E.1).
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
"""Range of the probability with which a persistent walk repeats its last action; drawn once per episode."""

REST = 0.5
"""Probability with which a walk to goals stays one more step in the cell that it has reached."""

WANDER = 2.5
"""The next cell of a sweep is at most this many steps farther away than the nearest one."""


def towards(here: Float[np.ndarray, "B 2"], target: Float[np.ndarray, "B 2"]) -> Float[np.ndarray, "B A"]:
    """Probabilities of a move towards the target, along each axis in proportion to the distance; at the target, stay."""
    weight = np.maximum((target - here) @ MOVES.T, 0.0)
    weight[:, -1] = weight.sum(axis=1) == 0
    result: np.ndarray = weight / weight.sum(axis=1, keepdims=True)
    return result


class Walks(DiscretePolicy):
    """One episode of a behavior policy in each of B rows.

    ``random``: uniform over the actions.  ``persistent``: repeats the last action or takes a random
    one.  ``goals``: walks to a random cell, rests there, then walks to another, so that some contexts
    resemble those of a good agent.  ``sweep``: walks to cells that it has not visited, near ones
    first, so that some contexts contain a long unsuccessful search.
    """

    def __init__(self, size: int, horizon: int, kinds: Sequence[str], rngs: Sequence[np.random.Generator]) -> None:
        """``kinds`` and ``rngs`` have one entry per row; draws come from a child of each generator, not from itself."""
        rows = len(kinds)
        self._persistent, self._goals, self._sweep = (
            np.array([k == kind for k in kinds]) for kind in ("persistent", "goals", "sweep")
        )
        self._cells = cells(size)
        self._keep = np.zeros(rows)
        self._rest = np.zeros((horizon, rows), bool)
        self._preference = np.zeros((rows, len(self._cells)))
        for row in np.flatnonzero(self._persistent | self._goals | self._sweep).tolist():
            own = rngs[row].spawn(1)[0]
            self._keep[row] = own.uniform(*KEEP)
            self._rest[:, row] = own.random(horizon) < REST
            self._preference[row] = own.random(len(self._cells))
        self._last = np.full(rows, -1)
        self._target = np.full(rows, -1)
        self._visited = np.zeros((rows, len(self._cells)), bool)
        self._step = 0

    def probabilities(self, observation: Float32[np.ndarray, "B 2"]) -> Float[np.ndarray, "B A"]:
        rows = np.arange(len(observation))
        probs = np.full((len(rows), ACTIONS), 1.0 / ACTIONS)
        again = self._persistent & (self._last >= 0)
        probs[again] *= (1 - self._keep[again])[:, None]
        probs[rows[again], self._last[again]] += self._keep[again]
        walking = self._goals | self._sweep
        if walking.any():
            self._choose(observation, walking)
            probs[walking] = towards(observation[walking], self._cells[self._target[walking]])
        return probs

    def _choose(self, here: Float32[np.ndarray, "B 2"], walking: Bool[np.ndarray, " B"]) -> None:
        """Choose the next target of each row that has reached its target and does not rest."""
        rows = np.arange(len(here))
        away = np.abs(self._cells[None] - here[:, None]).sum(axis=2)
        self._visited |= self._sweep[:, None] & (away == 0)
        self._visited[self._visited.all(axis=1)] = False
        there = away[rows, self._target] == 0
        resting = there & self._goals & self._rest[self._step]
        visited = self._sweep & self._visited[rows, self._target]
        free = walking & ((self._target < 0) | (there & ~resting) | visited)
        self._visited |= self._goals[:, None] & (away == 0) & free[:, None]
        cost = np.where(self._sweep[:, None], away + WANDER * self._preference, self._preference)
        self._target = np.where(free, np.where(self._visited, np.inf, cost).argmin(axis=1), self._target)

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int64[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._last = action.copy()
        self._step += 1
