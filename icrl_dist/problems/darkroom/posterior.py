"""What T_theta believes of the goal of a Dark Room, beside what it should.

A perfectly pretrained T_theta acts by posterior sampling (Theorem E.3): given D its law at s
is sum_g P(g | D) pi*_g(. | s).  Read backwards, its laws at all cells imply a posterior: that
mixture of optimal policies that is nearest to them.
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

TOLERANCE, ROUNDS = 1e-3, 400
"""Where the search for the nearest mixture ends: nats a cell from the best one, or so many rounds."""


class Implied(NamedTuple):
    """The mixtures of M policies nearest to B laws, and how near."""

    weight: Float64[np.ndarray, "B M"]
    divergence: Float64[np.ndarray, " B"]
    """Mean KL(T_theta || mixture) over the cells, in nats: how far T_theta is from any posterior sampling.

    Where no policy would do what T_theta may do it is infinite in truth; that part is left out."""
    gap: Float64[np.ndarray, " B"]
    """No mixture's divergence is smaller than this one's by more, nats a cell."""


def implied(law: Float[np.ndarray, "B C A"], policies: Float[np.ndarray, "M C A"], rounds: int = ROUNDS) -> Implied:
    """argmin_w sum_s KL(T_theta(. | s, D) || sum_m w_m pi*_m(. | s)) of each row.

    By expectation maximisation, w_m <- w_m / C * sum_{s,a} T(a | s) pi_m(a | s) / mix(a | s), which
    never moves away from the one minimum of this convex problem; a factor is taken to a power that
    grows as long as that does no harm.
    """
    target, basis = law.reshape(len(law), -1).astype(np.float64), policies.reshape(len(policies), -1).astype(np.float64)
    target = np.where(basis.any(axis=0), target, 0.0)
    mass = target.sum(axis=1, keepdims=True)
    weight, power = _beginning(law, policies), np.ones((len(law), 1))
    mix = weight @ basis
    for _ in range(rounds):
        pull = np.divide(target, mix, out=np.zeros_like(mix), where=target > 0) @ basis.T / mass
        gap = (pull.max(axis=1) - 1.0) * mass[:, 0] / law.shape[1]
        if (gap < TOLERANCE).all():
            break
        bold = weight * pull**power
        bold /= bold.sum(axis=1, keepdims=True)
        bold_mix = bold @ basis
        harm = (target * np.log(np.divide(bold_mix, mix, out=np.ones_like(mix), where=target > 0))).sum(axis=1) < 0
        if harm.any():
            bold = np.where(harm[:, None], weight * pull, bold)
            bold_mix = bold @ basis
        power = np.where(harm[:, None], 1.0, power * 1.5)
        weight, mix = bold, bold_mix
    ratio = np.divide(target, mix, out=np.ones_like(target), where=target > 0)
    return Implied(weight, (target * np.log(ratio)).sum(axis=1) / law.shape[1], gap)


def _beginning(law: Float[np.ndarray, "B C A"], policies: Float[np.ndarray, "M C A"]) -> Float64[np.ndarray, "B M"]:
    """Where to begin: how likely T_theta is to do, in each policy's most telling place, what this policy does there.

    If T_theta is a mixture of policies that have such places to themselves, these are its weights.
    """
    flat = policies.reshape(len(policies), -1).astype(np.float64)
    telling = (flat / np.maximum(flat.sum(axis=0), 1e-300)).argmax(axis=1)
    guess = law.reshape(len(law), -1)[:, telling] / flat[np.arange(len(flat)), telling] + 1e-6
    result: np.ndarray = guess / guess.sum(axis=1, keepdims=True)
    return result


def hypotheses(size: int, horizon: int, adversaries: Sequence[Adversary]) -> Hypotheses:
    """A goal in every cell, with each of these adversaries."""
    rooms = [task(divmod(cell, size), size, horizon) for cell in range(size * size)]
    return Hypotheses.of([Variation(room, adversary) for room in rooms for adversary in adversaries])


def by_goal(h: Hypotheses, weight: Float64[np.ndarray, " M"]) -> Float64[np.ndarray, " C"]:
    """The hypotheses' weights, summed over what is not the goal."""
    result: np.ndarray = np.bincount(h.goal, weight, h.size**2)
    return result


def exact(h: Hypotheses, context: Context) -> Float64[np.ndarray, " C"]:
    """P(goal | D) by cell, all of ``h`` equally likely before.  Raises ValueError if D refutes all of them."""
    before, action, after, reward = context
    seen = log_likelihood(h, cell_numbers(before, h.size), action.astype(np.int64), reward, cell_numbers(after, h.size))
    return by_goal(h, posterior(np.full(len(h.p), -np.log(len(h.p))), seen.sum(axis=0)))


class Believer(Protocol):
    """Whoever can be asked what it would do anywhere, and what it has seen (``rollout.InContextPolicy``, ``agent``)."""

    def distribution(self, states: Float32[np.ndarray, "Q S"], row: int = 0) -> Float[np.ndarray, "Q A"]: ...

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]: ...


class Belief(NamedTuple):
    """What T_theta's laws imply of the goal, and the exact posterior given the same context, by cell number."""

    implied: Float64[np.ndarray, " C"]
    exact: Float64[np.ndarray, " C"]
    divergence: float
    """Of ``Implied``."""
    transitions: int
    """In the context."""


class Room:
    """One room and what its adversary may be, made once to read many beliefs."""

    def __init__(self, size: int, horizon: int, adversaries: Sequence[Adversary], gamma: float, slack: float) -> None:
        """``gamma`` and ``slack``: what the policies pi*_g are optimal for (``oracle.soft_labels``), as in training."""
        self._h = hypotheses(size, horizon, adversaries)
        self._policies = soft_labels(self._h, gamma, slack)
        self._cells = cells(size)

    def read(self, of: Believer, row: int = 0, last: int | None = None) -> Belief:
        """The belief of environment ``row``; the exact one given only the ``last`` transitions of the context, if that is said.

        Raises ValueError if these refute every hypothesis.
        """
        found = implied(of.distribution(self._cells, row)[None], self._policies)
        context = of.context(row)
        begin = 0 if last is None else max(0, len(context[1]) - last)
        right = exact(self._h, [column[begin:] for column in context])
        return Belief(by_goal(self._h, found.weight[0]), right, float(found.divergence[0]), len(context[1]))


class RoomBelief:
    """Reads the belief about the goal of one variation, for the monitor plane."""

    def __init__(self, config: DarkRoomConfig, variation: Variation) -> None:
        task = variation.task
        adversaries = list(dict.fromkeys((NULL, variation.adversary)))
        self._size, self._goal = int(task.number("size")), [int(c) for c in task.vector("goal")]
        self._room = Room(self._size, int(task.number("horizon")), adversaries, config.gamma, config.label_slack)

    def message(self, policy: Believer, row: int) -> dict[str, Any]:
        """``size``, ``goal``, the implied and the exact distribution over cells, their divergence, the context's length."""
        belief = self._room.read(policy, row)
        return {
            "size": self._size,
            "goal": self._goal,
            "implied": [round(float(p), 6) for p in belief.implied],
            "exact": [round(float(p), 6) for p in belief.exact],
            "divergence": belief.divergence,
            "transitions": belief.transitions,
        }
