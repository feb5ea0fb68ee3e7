"""The exact answers against slow enumeration, in small rooms."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import scipy.optimize

from icrl_dist.problems.darkroom import solver
from icrl_dist.problems.darkroom.adversaries import argmax_distribution
from icrl_dist.problems.darkroom.room import ACTIONS, DarkRoom
from icrl_dist.problems.darkroom.solver import Hypotheses
from icrl_dist.types import NULL, Adversary, Identity, Task, Trajectory, Variation
from tests.optional import known

ALPHA = (0.1, 1.0, 0.5, 2.0, 0.3)
ADVERSARIES = (NULL, Adversary.of("dirichlet", p=0.35, alpha=ALPHA))
DISTURBED = (
    Adversary.of("wind", p=0.35, direction=2),
    Adversary.of("permuted", p=0.6, permutation=(2, 3, 1, 0, 4)),
)
SIZE, HORIZON = 3, 6
Room = Callable[[int, int], tuple[Task, ...]]
Cell = tuple[int, int]


@pytest.fixture(params=[ADVERSARIES, DISTURBED, (ADVERSARIES[1], DISTURBED[0])], ids=["override", "disturbed", "mixed"])
def hypotheses(room: Room, request: pytest.FixtureRequest) -> tuple[Variation, ...]:
    """Every goal of a 3x3 room with two adversaries: 18 variations."""
    return tuple(Variation(t, a) for t in room(SIZE, HORIZON) for a in request.param)


# A slow second implementation of the room.


@functools.cache
def override_of(variation: Variation) -> tuple[float, list[float]]:
    if variation.adversary == NULL:
        return 0.0, [0.2] * 5
    if variation.adversary.kind == "uniform":
        return variation.adversary.number("p"), [0.2] * 5
    return variation.adversary.number("p"), [float(q) for q in argmax_distribution(variation.adversary.vector("alpha"))]


def moved(cell: Cell, action: int, size: int) -> Cell:
    dx, dy = [(1, 0), (-1, 0), (0, 1), (0, -1), (0, 0)][action]
    return min(max(cell[0] + dx, 0), size - 1), min(max(cell[1] + dy, 0), size - 1)


def outcomes(variation: Variation, cell: Cell, action: int) -> list[tuple[float, Cell]]:
    """Every (probability, next cell) of an action, one entry an executed action."""
    size, adversary = int(variation.task.number("size")), variation.adversary
    if adversary.kind in ("wind", "permuted"):
        p = adversary.number("p")
        if adversary.kind == "wind":
            disturbed = moved(moved(cell, action, size), int(adversary.number("direction")), size)
        else:
            disturbed = moved(cell, int(adversary.vector("permutation")[action]), size)
        return [(1 - p, moved(cell, action, size)), (p, disturbed)]
    p, q = override_of(variation)
    return [(1 - p, moved(cell, action, size)), *((p * q[b], moved(cell, b, size)) for b in range(ACTIONS))]


def slow_q(
    variation: Variation, cell: Cell, steps: int, gamma: float, memo: dict[tuple[Cell, int], list[float]]
) -> list[float]:
    """Q of each action with ``steps`` to go, by recursion over all outcomes."""
    if (cell, steps) not in memo:
        values = []
        for action in range(ACTIONS):
            total = 0.0
            for probability, arrived in outcomes(variation, cell, action):
                reward = 1.0 if arrived == variation.task["goal"] else 0.0
                later = max(slow_q(variation, arrived, steps - 1, gamma, memo)) if steps > 1 else 0.0
                total += probability * (reward + gamma * later)
            values.append(total)
        memo[cell, steps] = values
    return memo[cell, steps]


def every_cell(size: int = SIZE) -> list[Cell]:
    return [(x, y) for x in range(size) for y in range(size)]


def episode(variation: Variation, seed: int) -> Trajectory:
    """A random policy in the real room."""
    rng = np.random.default_rng(seed)
    room = DarkRoom([variation])
    states, actions, rewards, override = [room.reset([rng])[0]], [], [], []
    for _ in range(room.spec.horizon):
        actions.append(int(rng.integers(ACTIONS)))
        step = room.step(np.array(actions[-1:]))
        states.append(step.observation[0])
        rewards.append(step.reward[0])
        override.append(step.adversary[0])
    return Trajectory(
        identity=Identity("pretrain", 0, 0, 0, seed),
        variation=variation,
        policy_version=-1,
        weights_digest="",
        worker="test",
        observations=np.array(states, np.float32),
        actions=np.array(actions, np.int16),
        rewards=np.array(rewards, np.float32),
        adversary=np.array(override, np.int16),
        queries=np.zeros((0, 2), np.float32),
        labels=np.zeros((0, 5), np.float32),
        prev_actions=np.zeros(0, np.int16),
        prev_rewards=np.zeros(0, np.float32),
        origin="none",
    )


def slow_likelihood(variation: Variation, seen: Sequence[Trajectory], steps: int | None = None) -> float:
    """P(D | tau, phi) as a product, transition by transition."""
    total = 1.0
    for one in seen:
        for h in range(len(one.actions) if steps is None else steps):
            cell, arrived = ((int(one.observations[i, 0]), int(one.observations[i, 1])) for i in (h, h + 1))
            probability = sum(p for p, there in outcomes(variation, cell, int(one.actions[h])) if there == arrived)
            right = float(one.rewards[h]) == (1.0 if arrived == variation.task["goal"] else 0.0)
            total *= probability * right
    return total


def normalized(weights: Sequence[float]) -> list[float]:
    return [w / sum(weights) for w in weights]


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_q_values_equal_the_recursion(hypotheses: tuple[Variation, ...], gamma: float) -> None:
    q = solver.q_values(Hypotheses.of(hypotheses), gamma)
    for m, variation in enumerate(hypotheses):
        memo: dict[tuple[Cell, int], list[float]] = {}
        slow = [slow_q(variation, cell, HORIZON, gamma, memo) for cell in every_cell()]
        np.testing.assert_allclose(q[m], slow, atol=1e-12)


@pytest.mark.parametrize("start", [(0, 0), (2, 1)])
def test_optimal_returns_equal_the_recursion(hypotheses: tuple[Variation, ...], start: Cell) -> None:
    best = solver.optimal_returns(Hypotheses.of(hypotheses), start)
    np.testing.assert_allclose(best, [max(slow_q(v, start, HORIZON, 1.0, {})) for v in hypotheses], atol=1e-12)
    # Without disturbance the return follows from the distance: the first reward comes with the arrival.
    for value, v in zip(best, hypotheses, strict=True):
        distance = sum(abs(g - s) for g, s in zip(v.task.vector("goal"), start, strict=True))
        if v.adversary == NULL:
            assert value == pytest.approx(HORIZON - max(distance, 1) + 1)


def test_soft_labels_are_uniform_over_the_near_best(hypotheses: tuple[Variation, ...]) -> None:
    gamma = 0.99
    for slack in (1e-9, 0.1, 100.0):
        labels = solver.soft_labels(Hypotheses.of(hypotheses), gamma, slack)
        for m, variation in enumerate(hypotheses):
            memo: dict[tuple[Cell, int], list[float]] = {}
            for c, cell in enumerate(every_cell()):
                q = slow_q(variation, cell, HORIZON, gamma, memo)
                good = [value >= max(q) - slack for value in q]
                np.testing.assert_allclose(labels[m, c], [g / sum(good) for g in good], atol=1e-6)


def test_heuristic_is_y_first_then_x_then_stay(room: Room) -> None:
    labels = solver.heuristic_labels(Hypotheses.of([Variation(t) for t in room(4, 5)]))
    for goal, (gx, gy) in enumerate(every_cell(4)):
        for cell, (x, y) in enumerate(every_cell(4)):
            if y != gy:
                action = 2 if gy > y else 3
            elif x != gx:
                action = 0 if gx > x else 1
            else:
                action = 4
            assert labels[goal, cell].tolist() == [float(a == action) for a in range(ACTIONS)]


def slow_return(variation: Variation, policy: np.ndarray) -> float:
    """Undiscounted return from (0, 0) of a stationary policy ``(C, A)``."""
    size, horizon = int(variation.task.number("size")), int(variation.task.number("horizon"))
    value = dict.fromkeys(every_cell(size), 0.0)
    for _ in range(horizon):
        fresh = {}
        for x, y in value:
            total = 0.0
            for action in range(ACTIONS):
                for probability, arrived in outcomes(variation, (x, y), action):
                    reward = 1.0 if arrived == variation.task["goal"] else 0.0
                    total += float(policy[x * size + y, action]) * probability * (reward + value[arrived])
            fresh[x, y] = total
        value = fresh
    return value[0, 0]


def test_heuristic_is_optimal_only_without_disturbance(room: Room) -> None:
    strong = Adversary.of("dirichlet", p=0.6, alpha=(0.2, 0.3, 0.1, 2.0, 0.1))
    for adversary, loses in ((NULL, False), (strong, True)):
        variations = [Variation(t, adversary) for t in room(4, 12)]
        h = Hypotheses.of(variations)
        rule, best = solver.heuristic_labels(h), solver.optimal_returns(h)
        loss = [b - slow_return(v, rule[m]) for m, (v, b) in enumerate(zip(variations, best, strict=True))]
        assert min(loss) > -1e-9
        assert (np.mean(loss) > 0.05) == loses
        assert loses or max(loss) < 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_posterior_equals_enumeration(hypotheses: tuple[Variation, ...], seed: int) -> None:
    seen = [episode(hypotheses[(5 * seed + 1) % 18], seed), episode(hypotheses[(5 * seed + 1) % 18], seed + 100)]
    h = Hypotheses.of(hypotheses)
    loglik = np.sum([solver.trajectory_log_likelihood(h, one) for one in seen], axis=0)
    slow = [slow_likelihood(v, seen) for v in hypotheses]
    np.testing.assert_allclose(np.exp(loglik), slow, rtol=1e-9)
    prior = [1.0 + (i % 5) for i in range(18)]
    belief = solver.posterior(np.log(normalized(prior)), loglik)
    np.testing.assert_allclose(belief, normalized([a * b for a, b in zip(prior, slow, strict=True)]), rtol=1e-9)
    assert belief[(5 * seed + 1) % 18] > 0, "the true hypothesis has probability 0"
    assert 0 < (belief > 0).sum() < 18


def test_a_reward_and_its_absence_both_count(hypotheses: tuple[Variation, ...]) -> None:
    h = Hypotheses.of(hypotheses)
    stay, here = np.array([4]), np.array([4])
    with_reward = np.exp(solver.log_likelihood(h, here, stay, np.array([1.0], np.float32), here))[0]
    without = np.exp(solver.log_likelihood(h, here, stay, np.array([0.0], np.float32), here))[0]
    at_goal = np.array([v.task["goal"] == (1, 1) for v in hypotheses])
    assert ((with_reward > 0) == at_goal).all()
    assert ((without > 0) == ~at_goal).all()


def test_posterior_of_many_contexts_at_once_and_of_unlikely_ones() -> None:
    """Rows are independent, and log-likelihoods far below float's range can still be normalized."""
    loglik = np.array([[-5000.0, -5000.0 + math.log(3)], [-np.inf, -1.0]])
    belief = solver.posterior(np.log(np.array([0.5, 0.5])), loglik)
    np.testing.assert_allclose(belief, [[0.25, 0.75], [0.0, 1.0]])


def test_an_impossible_context_raises(hypotheses: tuple[Variation, ...]) -> None:
    h = Hypotheses.of(hypotheses)
    # No adversary can move the agent from (0, 0) to (2, 2) in one step.
    jump = solver.log_likelihood(h, np.array([0]), np.array([4]), np.array([0.0], np.float32), np.array([8]))
    with pytest.raises(ValueError, match="probability 0 under every hypothesis"):
        solver.posterior(np.zeros(18), jump[0])
    possible = np.zeros((2, 18))
    possible[1] = jump[0]
    with pytest.raises(ValueError, match="probability 0"):
        solver.posterior(np.zeros(18), possible)


def test_posterior_action_is_the_sum_over_hypotheses(hypotheses: tuple[Variation, ...]) -> None:
    h = Hypotheses.of(hypotheses)
    labels = solver.soft_labels(h, 0.99, 0.1)
    rng = np.random.default_rng(0)
    belief = rng.dirichlet([0.3] * 18, size=7)
    cell = rng.integers(0, 9, size=7)
    result = solver.posterior_action(belief, labels, cell)
    for b in range(7):
        for action in range(ACTIONS):
            slow = sum(float(belief[b, m]) * float(labels[m, cell[b], action]) for m in range(18))
            assert result[b, action] == pytest.approx(slow)


def test_hypotheses_of_unlike_rooms_are_refused(room: Room) -> None:
    with pytest.raises(ValueError, match=r"\(3, 6\), \(4, 6\)"):
        Hypotheses.of([Variation(room(3, 6)[0]), Variation(room(4, 6)[0])])
    with pytest.raises(ValueError, match=r"goal=\(5, 5\)"):
        Hypotheses.of([Variation(room(3, 6)[0].replace(goal=(5, 5)))])


def slow_robust(task: Task, p: float, gamma: float) -> dict[Cell, list[float]]:
    """max-min Q at the first step: in every cell and step the matrix game of all pairs (agent's action, override)."""
    size, horizon = int(task.number("size")), int(task.number("horizon"))
    value, q = dict.fromkeys(every_cell(size), 0.0), dict[Cell, list[float]]()
    for _ in range(horizon):
        fresh = {}
        for cell in value:
            arrived = [moved(cell, action, size) for action in range(ACTIONS)]
            worth = [(1.0 if there == task["goal"] else 0.0) + gamma * value[there] for there in arrived]
            game = np.array([[(1 - p) * worth[a] + p * worth[b] for b in range(ACTIONS)] for a in range(ACTIONS)])
            q[cell] = [min(row) for row in game]
            # The value over randomized policies: the largest v that some mixture of rows secures in every column.
            found = scipy.optimize.linprog(
                [0.0] * ACTIONS + [-1.0],
                A_ub=np.hstack([-game.T, np.ones((ACTIONS, 1))]),
                b_ub=np.zeros(ACTIONS),
                A_eq=[[1.0] * ACTIONS + [0.0]],
                b_eq=[1.0],
                bounds=[(0, None)] * ACTIONS + [(None, None)],
            )
            fresh[cell] = -known(found.fun)
        value = fresh
    return q


@pytest.mark.parametrize("p", [0.0, 0.2, 0.7])
def test_robust_labels_are_those_of_the_matrix_games(room: Room, p: float) -> None:
    """Goals in a corner, on a wall and in the middle.  No randomized policy is worth more than the best action."""
    gamma, tasks = 0.9, [room(SIZE, HORIZON)[cell] for cell in (0, 1, 4)]
    h = Hypotheses.of([Variation(task) for task in tasks])
    q = solver.robust_q_values(h, p, gamma)
    for slack in (1e-6, 0.1):
        labels = solver.robust_labels(h, p, gamma, slack)
        for m, task in enumerate(tasks):
            slow = slow_robust(task, p, gamma)
            for c, cell in enumerate(every_cell()):
                np.testing.assert_allclose(q[m, c], slow[cell], atol=1e-9)
                good = [value >= max(slow[cell]) - slack for value in slow[cell]]
                np.testing.assert_allclose(labels[m, c], [g / sum(good) for g in good], atol=1e-6)


def test_the_best_robust_value_is_the_minimax_oracles_and_p_0_is_the_optimum(room: Room) -> None:
    task = room(SIZE, HORIZON)[5].replace(start=(0, 0))
    h = Hypotheses.of([Variation(task)])
    assert solver.robust_q_values(h, 0.4, 1.0)[0, 0].max() == pytest.approx(solver.worst_case(None, Variation(task), 0.4))
    np.testing.assert_array_equal(solver.robust_labels(h, 0.0, 0.99, 0.1), solver.soft_labels(h, 0.99, 0.1))
