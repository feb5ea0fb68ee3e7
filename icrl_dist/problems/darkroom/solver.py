"""Exact solutions of Dark Room: optimal values, labels, the posterior over (tau, phi).

A variation is a finite MDP with P = (1 - p) P_a + p sum_b q_b P_b under an override, and P = sum_x P(x | a) P_x
over moves x under any adversary, so value iteration is exact and takes milliseconds.  All functions compute M
hypotheses (goal and adversary) at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from icrl_dist.problems.darkroom.adversaries import is_override, move_distribution, override_distribution
from icrl_dist.problems.darkroom.room import ACTIONS, MOVES, cells, check, next_cell, next_move
from icrl_dist.types import NULL, Trajectory, Variation


@dataclass(frozen=True)
class Hypotheses:
    """M variations of one room as arrays: the possible environments.

    With a leading axis each row of a batch has its own hypotheses; only ``log_likelihood`` accepts that.
    """

    size: int
    horizon: int
    goal: Int[np.ndarray, "*B M"]
    """Cell number of the goal."""
    p: Float64[np.ndarray, "*B M"]
    q: Float64[np.ndarray, "*B M A"]
    """p and q of an override: with probability p the executed action is drawn from q."""
    moves: Float64[np.ndarray, "*B M A X"] | None = None
    """P(move | action) if an adversary is no override, as in ``room.next_move``; p and q are then not used."""

    @classmethod
    def of(cls, variations: Sequence[Variation]) -> Hypotheses:
        """Raises ValueError unless all variations share one size and horizon."""
        for v in variations:
            check(v.task)
        shapes = {(int(v.task.number("size")), int(v.task.number("horizon"))) for v in variations}
        if len(shapes) != 1:
            raise ValueError(f"hypotheses must share one size and horizon, not {sorted(shapes)}")
        (size, horizon) = shapes.pop()
        goal = np.array([int(g[0]) * size + int(g[1]) for g in (v.task.vector("goal") for v in variations)])
        adversaries = {v.adversary for v in variations}
        if all(map(is_override, adversaries)):
            by_adversary = {a: override_distribution(a, ACTIONS) for a in adversaries}
            overrides = [by_adversary[v.adversary] for v in variations]
            return cls(size, horizon, goal, np.array([p for p, _ in overrides]), np.stack([q for _, q in overrides]))
        distributions = {a: move_distribution(a, ACTIONS) for a in adversaries}
        return cls.of_moves(size, horizon, goal, np.stack([distributions[v.adversary] for v in variations]))

    @classmethod
    def of_moves(
        cls, size: int, horizon: int, goal: Int[np.ndarray, "*B M"], moves: Float64[np.ndarray, "*B M A X"]
    ) -> Hypotheses:
        """Hypotheses with any disturbance; p and q are not numbers."""
        return cls(size, horizon, goal, np.full(goal.shape, np.nan), np.full((*goal.shape, ACTIONS), np.nan), moves)

    def as_moves(self) -> Hypotheses:
        """The same hypotheses with ``moves``."""
        if self.moves is not None:
            return self
        moves = np.zeros((*self.p.shape, ACTIONS, next_move(2).shape[1]))
        moves[..., :ACTIONS] = self.p[..., None, None] * self.q[..., None, :]
        moves[..., range(ACTIONS), range(ACTIONS)] += 1.0 - self.p[..., None]
        return Hypotheses.of_moves(self.size, self.horizon, self.goal, moves)

    def rewards(self) -> Float64[np.ndarray, "M C"]:
        """Reward for entering each cell."""
        return (np.arange(self.size**2)[None, :] == self.goal[:, None]).astype(np.float64)


def _backup(h: Hypotheses, value: Float64[np.ndarray, "M C"], gamma: float) -> Float64[np.ndarray, "M C A"]:
    """Q(s, a) = sum_x P(x | a) U(s_x), with U(s') = R(s') + gamma V(s'); of an override (1 - p) U(s_a) + p sum_b q_b U(s_b)."""
    if h.moves is not None:
        used = h.moves.any(axis=(0, 1))
        there = (h.rewards() + gamma * value)[:, next_move(h.size)[:, used]]
        return there @ h.moves[:, :, used].transpose(0, 2, 1)
    arrived = (h.rewards() + gamma * value)[:, next_cell(h.size)]
    overridden = np.einsum("mca,ma->mc", arrived, h.q)
    result: np.ndarray = (1 - h.p)[:, None, None] * arrived + (h.p[:, None] * overridden)[:, :, None]
    return result


def q_values(h: Hypotheses, gamma: float) -> Float64[np.ndarray, "M C A"]:
    """Optimal action values at the start of an episode, discounted by gamma."""
    value = np.zeros((len(h.goal), h.size**2))
    for _ in range(h.horizon - 1):
        value = _backup(h, value, gamma).max(axis=2)
    return _backup(h, value, gamma)


def optimal_values(h: Hypotheses) -> Float64[np.ndarray, "M C"]:
    """Expected undiscounted return of the optimal policy from every cell."""
    value = np.zeros((len(h.goal), h.size**2))
    for _ in range(h.horizon):
        value = _backup(h, value, 1.0).max(axis=2)
    return value


def optimal_returns(h: Hypotheses, start: Sequence[int] = (0, 0)) -> Float64[np.ndarray, " M"]:
    """Expected undiscounted return of the optimal policy from ``start``, which no agent can exceed."""
    best: np.ndarray = optimal_values(h)[:, int(start[0]) * h.size + int(start[1])]
    return best


def soft_labels(h: Hypotheses, gamma: float, slack: float) -> Float32[np.ndarray, "M C A"]:
    """pi*_{tau,phi} as a label: uniform over the actions whose value is within ``slack`` of the best (eq. 5).

    Without slack the model would have to learn differences between actions that hardly change the return.
    """
    return _near_best(q_values(h, gamma), slack)


def _near_best(q: Float64[np.ndarray, "M C A"], slack: float) -> Float32[np.ndarray, "M C A"]:
    good = q >= q.max(axis=2, keepdims=True) - slack
    result: np.ndarray = (good / good.sum(axis=2, keepdims=True)).astype(np.float32)
    return result


def robust_q_values(h: Hypotheses, p: float, gamma: float) -> Float64[np.ndarray, "M C A"]:
    """Action values of the robust policy (eq. 4) at the start of an episode, discounted by gamma.

    The adversary set is s-rectangular: in every cell and step the worst distribution q of the override, whose probability
    is p.  Q_h(s, a) = (1 - p) U_h(s_a) + p min_b U_h(s_b) with U_h(s') = R(s') + gamma max_a Q_{h+1}(s', a).  What the
    adversary does is independent of the agent's action, so no randomized policy of the agent is better.  ``h``: the
    tasks; their own adversaries must be the null adversary.
    """
    value = np.zeros((len(h.goal), h.size**2))
    for _ in range(h.horizon):
        undisturbed = _backup(h, value, gamma)
        q = (1 - p) * undisturbed + p * undisturbed.min(axis=2, keepdims=True)
        value = q.max(axis=2)
    return q


def robust_labels(h: Hypotheses, p: float, gamma: float, slack: float) -> Float32[np.ndarray, "M C A"]:
    """pi^rb_tau as a label: uniform over the actions whose ``robust_q_values`` are within ``slack`` of the best."""
    return _near_best(robust_q_values(h, p, gamma), slack)


def heuristic_labels(h: Hypotheses) -> Float32[np.ndarray, "M C A"]:
    """The paper's rule (appendix C.1): first align y with the goal, then x, then stay."""
    here = cells(h.size)[None, :, :]
    away = np.sign(here[0][h.goal][:, None, :] - here)
    move = np.where(away[..., 1:] != 0, away * [0, 1], away * [1, 0])
    match = (move[:, :, None, :] == MOVES[None, None]).all(axis=3)
    result: np.ndarray = match.astype(np.float32)
    return result


def worst_case(policy: Float[np.ndarray, "C A"] | None, variation: Variation, p: float) -> float:
    """Expected return of a Markov policy in the task, if the worst adversary overrides each action with probability p.

    This adversary knows the policy, and chooses by cell and step.  V_H = 0, and for h = H - 1 down to 0
    V_h(s) = (1 - p) sum_a pi(a | s) Q_h(s, a) + p min_b Q_h(s, b), where Q_h(s, a) = R(s_a) + V_{h+1}(s_a).

    Under Algorithm 1 the context is frozen within an episode, so T_theta(. | s, D) is such a policy: the value is
    a lower bound of the expected return of one episode with this context D, for all adversaries of strength p.
    It says nothing about how an adversary that acts while the context is collected changes D, and nothing about winds
    and permuted controls, which no override of the same strength can imitate.

    ``policy``: pi(a | s) by cell number (x * size + y) and action, as ``InContextAgent.distribution`` gives it; None: the
    policy that maximizes V against this adversary (the minimax oracle).  The adversary of the variation is not used.

    Raises ValueError for a p outside [0, 1] and for a policy of another shape or with rows that are no distributions.
    """
    check(variation.task)
    policies = None if policy is None else np.asarray(policy, np.float64)[None]
    return float(worst_cases(policies, [variation], p)[0])


def worst_cases(
    policies: Float[np.ndarray, "P C A"] | None, variations: Sequence[Variation], p: float
) -> Float64[np.ndarray, " B"]:
    """``worst_case`` of many policies at once: of each policy in the task of its variation.

    ``policies``: P = B, one for each variation, or P = 1, one for all; None: in each task the minimax oracle.
    Raises ValueError for a p outside [0, 1], for policies as in ``worst_case``, and for variations of several rooms.
    """
    if not 0 <= p <= 1:
        raise ValueError(f"p = {p}: a probability lies in [0, 1]")
    h = Hypotheses.of([Variation(one.task, NULL) for one in variations])
    return _from_start(policies, h, variations, lambda own, q: (1 - p) * own + p * q.min(axis=2))


def expected_returns(policies: Float[np.ndarray, "P C A"], variations: Sequence[Variation]) -> Float64[np.ndarray, " B"]:
    """Expected return of one episode of each Markov policy in its variation, under the adversary of this variation.

    ``policies``: as of ``worst_cases``, and so are the errors.
    """
    return _from_start(policies, Hypotheses.of(variations), variations, lambda own, q: own)


def _from_start(
    policies: Float[np.ndarray, "P C A"] | None,
    h: Hypotheses,
    variations: Sequence[Variation],
    value_of: Callable[[Float64[np.ndarray, "B C"], Float64[np.ndarray, "B C A"]], Float64[np.ndarray, "B C"]],
) -> Float64[np.ndarray, " B"]:
    """V_0 at the start of each variation, by backward recursion under the adversaries of ``h``.

    ``value_of``: from the value of the agent's own choice and Q_h of every action to V_h.  Without policies the agent's
    own choice is the best one.
    """
    if policies is not None:
        policies = np.asarray(policies, np.float64)
        if policies.ndim != 3 or len(policies) not in (1, len(variations)) or policies.shape[1:] != (h.size**2, ACTIONS):
            shape = f"({h.size**2}, {ACTIONS})"
            raise ValueError(f"policy of shape {policies.shape[1:]}: expected probabilities of shape {shape}")
        if not (policies >= 0).all() or not np.allclose(policies.sum(axis=2), 1, atol=1e-3):  # NaN fails the first comparison
            raise ValueError("policy: the rows must be distributions over actions, with no negative number and the sum 1")
        policies = policies / policies.sum(axis=2, keepdims=True)
    value = np.zeros((len(variations), h.size**2))
    for _ in range(h.horizon):
        q = _backup(h, value, 1.0)
        value = value_of(q.max(axis=2) if policies is None else (policies * q).sum(axis=2), q)
    starts = [variation.task.get("start", "random") for variation in variations]
    anywhere = [isinstance(start, (str, int, float)) for start in starts]
    cell = [0 if drawn else int(start[0]) * h.size + int(start[1]) for drawn, start in zip(anywhere, starts, strict=True)]  # type: ignore[index]
    return np.where(anywhere, value.mean(axis=1), value[np.arange(len(cell)), cell])


def cell_numbers(observations: Float[np.ndarray, "*B 2"], size: int) -> Int[np.ndarray, "*B"]:
    """Number of the cell of each observation."""
    xy = np.rint(observations).astype(np.int64)
    result: np.ndarray = xy[..., 0] * size + xy[..., 1]
    return result


def log_likelihood(
    h: Hypotheses,
    cell: Int[np.ndarray, " T"],
    action: Int[np.ndarray, " T"],
    reward: Float[np.ndarray, " T"],
    arrived: Int[np.ndarray, " T"],
) -> Float64[np.ndarray, "T M"]:
    """log P(s', r | s, a, tau, phi) of each transition under each hypothesis.

    -inf where the transition refutes the hypothesis.  The probability of the action is left out,
    because it is the same under every hypothesis (Assumption E.1).  Every transition may have its
    own hypotheses, ``h.p (T, M)``.
    """
    consistent = (arrived[:, None] == h.goal) == (reward[:, None] > 0.5)
    with np.errstate(divide="ignore"):
        result: np.ndarray = np.log(_arrival_probability(h, cell, action, arrived) * consistent)
    return result


def _arrival_probability(
    h: Hypotheses, cell: Int[np.ndarray, " T"], action: Int[np.ndarray, " T"], arrived: Int[np.ndarray, " T"]
) -> Float64[np.ndarray, "T M"]:
    if h.moves is not None:
        leads = (next_move(h.size)[cell] == arrived[:, None]).astype(np.float64)
        chosen = h.moves[np.arange(len(cell)), :, action] if h.moves.ndim == 4 else h.moves[:, action].transpose(1, 0, 2)
        return (chosen @ leads[:, :, None])[..., 0]
    reached = next_cell(h.size)[cell] == arrived[:, None]
    overridden = (h.q @ reached[:, :, None].astype(np.float64))[..., 0]
    result: np.ndarray = (1 - h.p) * reached[np.arange(len(cell)), action][:, None] + h.p * overridden
    return result


def trajectory_log_likelihood(h: Hypotheses, trajectory: Trajectory) -> Float64[np.ndarray, " M"]:
    """log P(xi | tau, phi) of a whole trajectory, without the probabilities of the agent's actions."""
    cell = cell_numbers(trajectory.observations, h.size)
    steps = log_likelihood(h, cell[:-1], trajectory.actions.astype(np.int64), trajectory.rewards, cell[1:])
    total: np.ndarray = steps.sum(axis=0)
    return total


def posterior(log_prior: Float64[np.ndarray, " M"], loglik: Float64[np.ndarray, "*B M"]) -> Float64[np.ndarray, "*B M"]:
    """P(tau, phi | D).  Raises ValueError if D refutes every hypothesis."""
    logits = log_prior + loglik
    top = logits.max(axis=-1, keepdims=True)
    if not np.isfinite(top).all():
        raise ValueError("the context has probability 0 under every hypothesis: check the room and the set of adversaries")
    weight = np.exp(logits - top)
    result: np.ndarray = weight / weight.sum(axis=-1, keepdims=True)
    return result


def posterior_action(
    belief: Float64[np.ndarray, "B M"],
    labels: Float32[np.ndarray, "M C A"],
    cell: Int[np.ndarray, " B"],
) -> Float64[np.ndarray, "B A"]:
    """P(a* | s_query, D): the output of a perfectly pretrained T_theta (Theorem E.3)."""
    return np.einsum("bm,mba->ba", belief, labels[:, cell].astype(np.float64))
