"""Agents without a network: the exact agent, which a perfectly pretrained T_theta equals, and the oracle.

An exact agent is given the room and the adversary of its row, but not the goal.  It samples a
hypothesis from the exact posterior and acts optimally for it (Theorem E.3); rules differ in when the
posterior is updated and how long a hypothesis is kept.  The agent draws no hypothesis: it samples the
action from the mixture over hypotheses, given its past observations and actions, which has the same
distribution.
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
"""Name of the exact agent of each rule in tables and figures."""
KEYS: dict[Rule, str] = {rule: f"exact:{rule.replace(' ', '-')}" for rule in RULES}
"""Key of the exact agent of each rule in result rows."""


class ExactAgent(DiscretePolicy):
    """Posterior sampling with the exact posterior (Theorem E.3).

    ``paper``: Algorithm 1, a new hypothesis at each step, the posterior updated at the end of an episode.
    ``every step``: the same, but updated at every transition.  ``windows``: updated at every
    transition, but a hypothesis is kept for ``WINDOW`` steps or until the episode ends.
    ``committed``: a hypothesis is kept, also across episodes, until a transition refutes it.
    ``zeta``: updated at every transition and conditioned on the last ``ZETA`` actions of the episode
    being right (eq. 6), as ``rollout.CommittedPolicy`` does.  If no hypothesis agrees with all of these
    actions, only the latest ones count, as many as some hypothesis agrees with.
    """

    def __init__(
        self,
        families: Sequence[Hypotheses],
        labels: Sequence[Float32[np.ndarray, "M C A"]],
        family: Int[np.ndarray, " B"],
        rule: Rule,
    ) -> None:
        """The prior of row b is uniform over the M variations ``families[family[b]]``.

        ``labels``: the optimal policies of each family, from ``soft_labels``.
        """
        self._size, self._rule, self._family = families[0].size, rule, family.copy()
        names = ["goal", "p", "q"]
        if any(h.moves is not None for h in families):
            families, names = [h.as_moves() for h in families], [*names, "moves"]
        stacked = (np.stack([getattr(h, name) for h in families])[family] for name in names)
        self._h = Hypotheses(self._size, families[0].horizon, *stacked)
        self._by_hypothesis = np.stack(labels).astype(np.float64)
        self._log_prior = np.full(self._h.p.shape[1], -np.log(self._h.p.shape[1]))
        self._loglik = np.zeros(self._h.p.shape)
        self._weight = self._posterior()
        self._step = 0
        self._zeta: list[Float64[np.ndarray, "B M"]] = []

    @property
    def _labels(self) -> Float64[np.ndarray, "F C A M"]:
        """A view: pickle would give an array in this order another layout in memory, and products other last bits."""
        return self._by_hypothesis.transpose(0, 2, 3, 1)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float64[np.ndarray, "B A"]:
        labels = self._labels[self._family, cell_numbers(observation, self._size)]
        probs: np.ndarray = (labels @ self._weight[:, :, None])[:, :, 0]
        return probs

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> Float64[np.ndarray, "B Q A"] | None:
        """The distributions at any states in the next episode; None for a rule that changes them within an episode."""
        if self._rule != "paper":
            return None
        cell = cell_numbers(states, self._size)
        return np.stack([self._labels[f, cell] @ weight for f, weight in zip(self._family, self._weight, strict=True)])

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        """Raises ValueError if the rule keeps a hypothesis and no hypothesis allows the action."""
        cell, arrived = cell_numbers(observation, self._size), cell_numbers(next_observation, self._size)
        seen = log_likelihood(self._h, cell, action.astype(np.int64), reward, arrived)
        self._loglik += seen
        self._step = 0 if done else self._step + 1
        if self._rule in ("windows", "committed"):
            self._weight = _normalized(self._weight * self._labels[self._family, cell, action])
        if self._rule == "committed":
            kept = np.where(np.isneginf(seen), 0.0, self._weight)
            self._weight = kept + (1.0 - kept.sum(axis=1, keepdims=True)) * self._posterior()
        elif self._rule == "zeta":
            right = self._labels[self._family, cell, action]
            self._zeta = [] if done else [*self._zeta, right][-ZETA:]
            self._weight = self._given_zeta()
        elif done or self._rule == "every step" or (self._rule == "windows" and self._step % WINDOW == 0):
            self._weight = self._posterior()

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int[np.ndarray, "B T"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add data D_off of any other policy, and drop the kept hypothesis."""
        cells, arrived = cell_numbers(observations, self._size), cell_numbers(next_observations, self._size)
        for t in range(actions.shape[1]):
            self._loglik += log_likelihood(self._h, cells[:, t], actions[:, t].astype(np.int64), rewards[:, t], arrived[:, t])
        self._zeta = []
        self._weight = self._posterior()

    def _given_zeta(self) -> Float64[np.ndarray, "B M"]:
        weight, agreed = self._posterior(), np.ones(len(self._family), bool)
        for right in reversed(self._zeta):
            both = weight * right
            agreed &= both.sum(axis=1) > 0
            weight = np.where(agreed[:, None], both, weight)
        return _normalized(weight)

    def _posterior(self) -> Float64[np.ndarray, "B M"]:
        return posterior(self._log_prior, self._loglik)


def _normalized(weight: Float64[np.ndarray, "B M"]) -> Float64[np.ndarray, "B M"]:
    total = weight.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise ValueError("observe got an action that the exact agent never takes: add data of other policies with append")
    result: np.ndarray = weight / total
    return result


class OptimalAgent(DiscretePolicy):
    """The oracle: it is given tau and phi, and follows pi*_{tau,phi} of eq. (5)."""

    def __init__(self, labels: Float32[np.ndarray, "B C A"], size: int) -> None:
        self._labels, self._size = labels.copy(), size

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float64[np.ndarray, "B A"]:
        cell = cell_numbers(observation, self._size)
        result: np.ndarray = self._labels[np.arange(len(cell)), cell].astype(np.float64)
        return result

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> Float64[np.ndarray, "B Q A"]:
        """The distributions at any states, which never change."""
        result: np.ndarray = self._labels[:, cell_numbers(states, self._size)].astype(np.float64)
        return result

    def observe(self, *transition: object) -> None:
        """Ignore the transition: the policy is fixed."""
