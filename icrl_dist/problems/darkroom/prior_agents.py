"""Exact agents that are given neither goal nor adversary, only a prior over both: that of DPT or that of ICAG.

Their returns are the ceilings of what DPT and ICAG could learn.  Goal and adversary are independent a priori.  Which
cells gave a reward tells the goal, and which moves were made tells the adversary, so both stay independent given the
context, and two small posteriors replace one over all pairs.  Given a belief the agent acts by the mixture of the
optimal policies of all pairs (Theorem E.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int

from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.problems.darkroom.adversaries import Disturbance, grid, move_distribution
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.problems.darkroom.room import ACTIONS, next_move, task
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, posterior, soft_labels
from icrl_dist.rollout.policies import DiscretePolicy
from icrl_dist.types import NULL, Adversary, Variation

PriorRule = Literal["paper", "committed"]
LEVELS: dict[Disturbance, int] = {"override": 8, "wind": 8, "permuted": 8}
"""Strengths p in ICAG's prior: 32 overrides, 32 winds or 56 permuted controls.  With twice as many no other return was shown
(docs/results/ceilings.md).  The numbers are even: of an odd number one would be p_max / 2, and at p = 1/2 a mirrored move
goes either way with equal probability, so no action is better than its opposite."""
_LEAST = 1e-9
"""Least probability of a transition under a hypothesis, so no transition refutes all of them."""


@dataclass(frozen=True, eq=False)
class Prior:
    """G = C equally likely goals in one room, J adversaries, and the optimal policy of each pair."""

    size: int
    log_weight: Float64[np.ndarray, " J"]
    """log P(adversary)."""
    moves: Float64[np.ndarray, "A J X"]
    """P(move | action, adversary); the moves are numbered as in ``room.next_move``."""
    labels: Float64[np.ndarray, "C A G J"]

    @classmethod
    def of(cls, room: DarkRoomConfig, weights: dict[Adversary, float]) -> Prior:
        """The prior in which each adversary has this weight.  The policies are the labels of training."""
        goals = [task(divmod(cell, room.size), room.size, room.horizon) for cell in range(room.size**2)]
        labels = np.empty((len(goals), ACTIONS, len(goals), len(weights)))
        for number, adversary in enumerate(weights):
            one = Hypotheses.of([Variation(goal, adversary) for goal in goals])
            labels[..., number] = soft_labels(one, room.gamma, room.label_slack).transpose(1, 2, 0)
        moves = np.stack([move_distribution(adversary, ACTIONS) for adversary in weights], axis=1)
        return cls(room.size, np.log(list(weights.values())), moves, labels)


def dpt_prior(room: DarkRoomConfig) -> Prior:
    """No disturbance, as the limit of ever weaker ones: what a transition says about the adversary changes nothing."""
    return Prior.of(room, {NULL: 1.0})


def icag_prior(room: DarkRoomConfig, adversary: AdversaryConfig, levels: int | None = None) -> Prior:
    """The adversaries of training: phi_0 with its share, else ``adversaries.grid`` with ``levels``; None: ``LEVELS``."""
    count = levels or LEVELS[room.disturbance]
    others = grid(room.disturbance, ACTIONS, adversary.p_max, count, adversary.p_min) if adversary.count else ()
    weights = {NULL: 1.0 / adversary.variations} if adversary.null else {}
    share = adversary.count / adversary.variations
    for one in others:  # equal ones, which a p_max of 0 makes, add up
        weights[one] = weights.get(one, 0.0) + share / len(others)
    return Prior.of(room, weights)


class PriorAgent(DiscretePolicy):
    """Posterior sampling with a prior over goals and adversaries (Theorem E.3).

    ``paper``: Algorithm 1, a new pair at each step, the posterior updated at the end of an episode.  ``committed``: the
    posterior is updated at every transition, and a goal is kept, also across episodes, until a transition refutes it.
    The adversary is drawn anew at each step, because hardly any transition refutes one: an agent that kept it would
    never drop a wrong one.  As ``ExactAgent``, the agent draws nothing and acts by the distribution over its draws.
    """

    def __init__(self, prior: Prior, rows: int, rule: PriorRule) -> None:
        self._prior, self._rule = prior, rule
        self._next = next_move(prior.size)
        goals, adversaries = prior.labels.shape[2:]
        self._log_goal = np.zeros((rows, goals))
        self._log_adversary = np.zeros((rows, adversaries))
        self._goal: Float64[np.ndarray, "B G"]
        self._adversary: Float64[np.ndarray, "B J"]
        self._table: Float64[np.ndarray, "B C A"] | None
        """Algorithm 1: the policy in every cell in this episode; None before the first step."""
        self._update()

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float64[np.ndarray, "B A"]:
        cell, labels = cell_numbers(observation, self._prior.size), self._prior.labels
        if self._rule == "committed":
            mixed: np.ndarray = (labels.reshape(*labels.shape[:2], -1)[cell] @ self._belief()[:, :, None])[..., 0]
            return mixed
        result: np.ndarray = self._frozen()[np.arange(len(cell)), cell]
        return result

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> Float64[np.ndarray, "B Q A"] | None:
        """The distributions at any states in the next episode; None for a rule that changes them within an episode."""
        if self._rule != "paper":
            return None
        result: np.ndarray = self._frozen()[:, cell_numbers(states, self._prior.size)]
        return result

    def _frozen(self) -> Float64[np.ndarray, "B C A"]:
        if self._table is None:
            belief, labels = self._belief(), self._prior.labels
            self._table = (belief @ labels.reshape(-1, belief.shape[1]).T).reshape(len(belief), *labels.shape[:2])
        return self._table

    def _belief(self) -> Float64[np.ndarray, "B M"]:
        """The probability of each pair of goal and adversary."""
        return (self._goal[:, :, None] * self._adversary[:, None]).reshape(len(self._goal), -1)

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        """Never raises: a transition that no hypothesis allows says nothing about the adversary."""
        cell, arrived = cell_numbers(observation, self._prior.size), cell_numbers(next_observation, self._prior.size)
        refuted = self._add(cell, action, reward, arrived)
        if self._rule == "paper":
            if done:
                self._update()
            return
        agreed = self._goal * (self._prior.labels[cell, action] @ self._adversary[:, :, None])[..., 0]
        total = agreed.sum(axis=1, keepdims=True)
        kept = np.where(refuted, 0.0, np.where(total > 0, agreed / np.where(total > 0, total, 1.0), self._goal))
        self._update()
        self._goal = kept + np.maximum(1.0 - kept.sum(axis=1, keepdims=True), 0.0) * self._goal

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int[np.ndarray, "B T"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add data D_off of any other policy, and drop the kept goal."""
        cells, arrived = (cell_numbers(o, self._prior.size) for o in (observations, next_observations))
        for t in range(actions.shape[1]):
            self._add(cells[:, t], actions[:, t], rewards[:, t], arrived[:, t])
        self._update()

    def _add(
        self, cell: Int[np.ndarray, " B"], action: Int[np.ndarray, " B"], reward: np.ndarray, arrived: Int[np.ndarray, " B"]
    ) -> np.ndarray:
        """Add a transition to the log-likelihoods.  Returns which goals it refutes, ``(B, G)``."""
        leads = (self._next[cell] == arrived[:, None]).astype(np.float64)
        probability = (self._prior.moves[action] @ leads[:, :, None])[..., 0]
        self._log_adversary += np.log(np.maximum(probability, _LEAST))
        refuted: np.ndarray = (arrived[:, None] == np.arange(self._prior.size**2)) != (reward[:, None] > 0.5)
        self._log_goal += np.where(refuted, np.log(_LEAST), 0.0)
        return refuted

    def _update(self) -> None:
        """Set the belief to the posterior."""
        self._goal = posterior(np.zeros(self._log_goal.shape[1]), self._log_goal)
        self._adversary = posterior(self._prior.log_weight, self._log_adversary)
        self._table = None


def prior_agents() -> Sequence[tuple[str, str, Literal["dpt", "icag"], PriorRule]]:
    """Key in result rows, name in tables, prior and rule of each agent."""
    return (
        ("exact:dpt", "exact, DPT's prior", "dpt", "paper"),
        ("exact:dpt-committed", "exact, DPT's prior, committed", "dpt", "committed"),
        ("exact:icag", "exact, ICAG's prior", "icag", "paper"),
        ("exact:icag-committed", "exact, ICAG's prior, committed", "icag", "committed"),
    )
