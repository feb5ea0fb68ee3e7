"""The posterior over goals that T_theta's action distributions imply, and the exact posterior.

A perfectly pretrained T_theta acts by posterior sampling (Theorem E.3): given D its distribution at s
is sum_g P(g | D) pi*_g(. | s).  Conversely, its distributions at all cells imply a posterior: the
weights of the mixture of optimal policies that is nearest to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Float32, Float64

from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.problems.darkroom.room import cells, task
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, log_likelihood, posterior, soft_labels
from icrl_dist.types import NULL, Adversary, Variation

Context = Sequence[np.ndarray]
"""Observations (T, S), actions (T), next observations (T, S) and rewards (T): ``rollout.InContextPolicy.context``."""

TOLERANCE, ITERATIONS = 1e-3, 400
"""The search for the nearest mixture ends within this many nats per cell of the minimum, or after this many iterations."""


class Implied(NamedTuple):
    """For each of B sets of distributions the nearest mixture of M policies, and their divergence."""

    weight: Float64[np.ndarray, "B M"]
    divergence: Float64[np.ndarray, " B"]
    """Mean KL(T_theta || mixture) over the cells, in nats: the distance of T_theta from posterior sampling.

    It leaves out actions that no policy takes, for which the divergence would be infinite."""
    gap: Float64[np.ndarray, " B"]
    """Upper bound on how much smaller the divergence of another mixture could be, in nats per cell."""


def implied(probs: Float[np.ndarray, "B C A"], policies: Float[np.ndarray, "M C A"], iterations: int = ITERATIONS) -> Implied:
    """argmin_w sum_s KL(T_theta(. | s, D) || sum_m w_m pi*_m(. | s)) of each row.

    By expectation maximization: w_m <- w_m / C * sum_{s,a} T(a | s) pi_m(a | s) / mix(a | s), which
    never increases this convex objective.  For speed the factor of w_m is raised to a power, which grows
    as long as the objective does not increase.
    """
    target, basis = probs.reshape(len(probs), -1).astype(np.float64), policies.reshape(len(policies), -1).astype(np.float64)
    target = np.where(basis.any(axis=0), target, 0.0)
    mass = target.sum(axis=1, keepdims=True)
    weight, power = _initial_weights(probs, policies), np.ones((len(probs), 1))
    mix = weight @ basis
    for _ in range(iterations):
        factor = np.divide(target, mix, out=np.zeros_like(mix), where=target > 0) @ basis.T / mass
        gap = (factor.max(axis=1) - 1.0) * mass[:, 0] / probs.shape[1]
        if (gap < TOLERANCE).all():
            break
        fast = weight * factor**power
        fast /= fast.sum(axis=1, keepdims=True)
        fast_mix = fast @ basis
        worse = (target * np.log(np.divide(fast_mix, mix, out=np.ones_like(mix), where=target > 0))).sum(axis=1) < 0
        if worse.any():
            fast = np.where(worse[:, None], weight * factor, fast)
            fast_mix = fast @ basis
        power = np.where(worse[:, None], 1.0, power * 1.5)
        weight, mix = fast, fast_mix
    ratio = np.divide(target, mix, out=np.ones_like(target), where=target > 0)
    return Implied(weight, (target * np.log(ratio)).sum(axis=1) / probs.shape[1], gap)


def _initial_weights(probs: Float[np.ndarray, "B C A"], policies: Float[np.ndarray, "M C A"]) -> Float64[np.ndarray, "B M"]:
    """Initial weights: for each policy T_theta's probability of the policy's most distinctive action.

    If T_theta is a mixture of policies, each with an action that no other policy takes, these are its weights.
    """
    flat = policies.reshape(len(policies), -1).astype(np.float64)
    distinctive = (flat / np.maximum(flat.sum(axis=0), 1e-300)).argmax(axis=1)
    weight = probs.reshape(len(probs), -1)[:, distinctive] / flat[np.arange(len(flat)), distinctive] + 1e-6
    result: np.ndarray = weight / weight.sum(axis=1, keepdims=True)
    return result


def hypotheses(size: int, horizon: int, adversaries: Sequence[Adversary]) -> Hypotheses:
    """One hypothesis per cell and adversary: the goal is in this cell."""
    rooms = [task(divmod(cell, size), size, horizon) for cell in range(size * size)]
    return Hypotheses.of([Variation(room, adversary) for room in rooms for adversary in adversaries])


def by_goal(h: Hypotheses, weight: Float64[np.ndarray, " M"]) -> Float64[np.ndarray, " C"]:
    """The weights of the hypotheses, summed over the adversaries of each goal."""
    result: np.ndarray = np.bincount(h.goal, weight, h.size**2)
    return result


def exact(h: Hypotheses, context: Context) -> Float64[np.ndarray, " C"]:
    """P(goal | D) by cell, with a uniform prior over ``h``.  Raises ValueError if D refutes every hypothesis."""
    before, action, after, reward = context
    seen = log_likelihood(h, cell_numbers(before, h.size), action.astype(np.int64), reward, cell_numbers(after, h.size))
    return by_goal(h, posterior(np.full(len(h.p), -np.log(len(h.p))), seen.sum(axis=0)))


class QueryablePolicy(Protocol):
    """A policy with access to its distribution in any state and to its context: ``InContextPolicy``, ``InContextAgent``."""

    def distribution(self, states: Float32[np.ndarray, "Q S"], row: int = 0) -> Float[np.ndarray, "Q A"]: ...

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]: ...


class Belief(NamedTuple):
    """The posterior over goals that T_theta's distributions imply, and the exact one given the same context, by cell."""

    implied: Float64[np.ndarray, " C"]
    exact: Float64[np.ndarray, " C"]
    divergence: float
    """See ``Implied.divergence``."""
    transitions: int
    """Number of transitions in the context."""


class RoomPosterior:
    """Computes beliefs in one room with given possible adversaries; the optimal policies are solved once."""

    def __init__(self, size: int, horizon: int, adversaries: Sequence[Adversary], gamma: float, slack: float) -> None:
        """``gamma`` and ``slack``: as in the labels of training (``soft_labels``)."""
        self._h = hypotheses(size, horizon, adversaries)
        self._policies = soft_labels(self._h, gamma, slack)
        self._cells = cells(size)

    def read(self, policy: QueryablePolicy, row: int = 0, last: int | None = None) -> Belief:
        """The belief of environment ``row``.

        ``last``: the exact posterior uses only this many of the context's last transitions; None for all.
        Raises ValueError if the transitions refute every hypothesis.
        """
        found = implied(policy.distribution(self._cells, row)[None], self._policies)
        context = policy.context(row)
        begin = 0 if last is None else max(0, len(context[1]) - last)
        posterior_of_goals = exact(self._h, [column[begin:] for column in context])
        return Belief(by_goal(self._h, found.weight[0]), posterior_of_goals, float(found.divergence[0]), len(context[1]))


class RoomBelief:
    """Computes the belief about the goal of one variation, for the monitor plane."""

    def __init__(self, config: DarkRoomConfig, variation: Variation) -> None:
        task = variation.task
        adversaries = list(dict.fromkeys((NULL, variation.adversary)))
        self._size, self._goal = int(task.number("size")), [int(c) for c in task.vector("goal")]
        self._room = RoomPosterior(self._size, int(task.number("horizon")), adversaries, config.gamma, config.label_slack)

    def message(self, policy: QueryablePolicy, row: int) -> dict[str, Any]:
        """``size``, ``goal``, the implied and the exact posterior by cell, the divergence, the context's length."""
        belief = self._room.read(policy, row)
        return {
            "size": self._size,
            "goal": self._goal,
            "implied": [round(float(p), 6) for p in belief.implied],
            "exact": [round(float(p), 6) for p in belief.exact],
            "divergence": belief.divergence,
            "transitions": belief.transitions,
        }
