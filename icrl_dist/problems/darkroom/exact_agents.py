"""Agents that know the exact answers: what a perfectly pretrained T_theta earns, and the oracle.

An exact agent knows the room and its row's adversary, not the goal.  It acts as Theorem E.3
says, by a hypothesis sampled from the exact posterior; rules differ in when the posterior is
updated and how long the hypothesis is kept.  None is ever drawn: the agent acts by the law
of the hypothesis, given what it saw and did, so it needs no chance beyond the action's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int

from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, log_likelihood, posterior
from icrl_dist.rollout.policies import DiscretePolicy

Rule = Literal["paper", "every step", "windows", "committed", "zeta"]
WINDOW = 5
ZETA = 11
RULES: dict[Rule, str] = {
    "paper": "exact, Algorithm 1",
    "every step": "exact, every step",
    "windows": f"exact, windows of {WINDOW}",
    "committed": "exact, committed",
    "zeta": f"exact, zeta of {ZETA}",
}
"""What tables and figures call the exact agent of each rule."""


class ExactAgent(DiscretePolicy):
    """The agent that Theorem E.3 promises: actions from the exact posterior, no network.

    ``paper``: Algorithm 1, a hypothesis a step, the posterior updated at an episode's end.
    ``every step``: the same, updated at every transition.  ``windows``: updated at every
    transition, but a hypothesis is kept for ``WINDOW`` steps, or to the episode's end.
    ``committed``: a hypothesis is kept, from episode to episode, until a transition refutes it.
    ``zeta``: the posterior, updated at every transition, given that the last ``ZETA`` actions of the
    episode were right (eq. 6): what ``rollout.CommittedPolicy`` does.  Of these as many count as
    some hypothesis agrees with, the last first.
    """

    def __init__(
        self,
        families: Sequence[Hypotheses],
        labels: Sequence[Float32[np.ndarray, "M C A"]],
        family: Int[np.ndarray, " B"],
        rule: Rule,
    ) -> None:
        """Row b holds the M variations ``families[family[b]]`` for possible, all equally."""
        self._size, self._rule, self._family = families[0].size, rule, family
        stacked = (np.stack([getattr(h, name) for h in families])[family] for name in ("goal", "p", "q"))
        self._h = Hypotheses(self._size, families[0].horizon, *stacked)
        self._labels = np.stack(labels).transpose(0, 2, 3, 1).astype(np.float64)
        self._log_prior = np.full(self._h.p.shape[1], -np.log(self._h.p.shape[1]))
        self._loglik = np.zeros(self._h.p.shape)
        self._guess = self._posterior()
        self._step = 0
        self._zeta: list[Float64[np.ndarray, "B M"]] = []

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float64[np.ndarray, "B A"]:
        labels = self._labels[self._family, cell_numbers(observation, self._size)]
        law: np.ndarray = (labels @ self._guess[:, :, None])[:, :, 0]
        return law

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        """Raises ValueError if the rule keeps a hypothesis and no hypothesis would have acted so."""
        cell, arrived = cell_numbers(observation, self._size), cell_numbers(next_observation, self._size)
        seen = log_likelihood(self._h, cell, action.astype(np.int64), reward, arrived)
        self._loglik += seen
        self._step = 0 if done else self._step + 1
        if self._rule in ("windows", "committed"):
            self._guess = _normalised(self._guess * self._labels[self._family, cell, action])
        if self._rule == "committed":
            kept = np.where(np.isneginf(seen), 0.0, self._guess)
            self._guess = kept + (1.0 - kept.sum(axis=1, keepdims=True)) * self._posterior()
        elif self._rule == "zeta":
            right = self._labels[self._family, cell, action]
            self._zeta = [] if done else [*self._zeta, right][-ZETA:]
            self._guess = self._given_zeta()
        elif done or self._rule == "every step" or (self._rule == "windows" and self._step % WINDOW == 0):
            self._guess = self._posterior()

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int[np.ndarray, "B T"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add data D_off of any other policy, and let go of the hypothesis kept."""
        cells, arrived = cell_numbers(observations, self._size), cell_numbers(next_observations, self._size)
        for t in range(actions.shape[1]):
            self._loglik += log_likelihood(self._h, cells[:, t], actions[:, t].astype(np.int64), rewards[:, t], arrived[:, t])
        self._zeta = []
        self._guess = self._posterior()

    def _given_zeta(self) -> Float64[np.ndarray, "B M"]:
        weight, agreed = self._posterior(), np.ones(len(self._family), bool)
        for right in reversed(self._zeta):
            both = weight * right
            agreed &= both.sum(axis=1) > 0
            weight = np.where(agreed[:, None], both, weight)
        return _normalised(weight)

    def _posterior(self) -> Float64[np.ndarray, "B M"]:
        return posterior(self._log_prior, self._loglik)


def _normalised(weight: Float64[np.ndarray, "B M"]) -> Float64[np.ndarray, "B M"]:
    total = weight.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise ValueError("the exact agent was told of an action that it never takes: give other policies' data to append")
    result: np.ndarray = weight / total
    return result


class OptimalAgent(DiscretePolicy):
    """The oracle: knows tau and phi, and follows pi*_{tau,phi} of eq. (5)."""

    def __init__(self, labels: Float32[np.ndarray, "B C A"], size: int) -> None:
        self._labels, self._size = labels, size

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float64[np.ndarray, "B A"]:
        cell = cell_numbers(observation, self._size)
        result: np.ndarray = self._labels[np.arange(len(cell)), cell].astype(np.float64)
        return result

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""
