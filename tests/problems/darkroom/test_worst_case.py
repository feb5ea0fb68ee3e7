"""The certified worst case of a policy in Dark Room, against enumeration of all adversaries and slow loops."""

import itertools

import numpy as np
import pytest

from icrl_dist import NULL, Variation, oracle
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns, worst_case
from icrl_dist.types import Adversary

MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1), (0, 0))


def moved(cell, action, size):
    x, y = divmod(cell, size)
    x, y = min(max(x + MOVES[action][0], 0), size - 1), min(max(y + MOVES[action][1], 0), size - 1)
    return x * size + y


def value_against(policy, chosen, p, goal, size, horizon, cell, step=0):
    """Expected return from a cell, where ``chosen[step, cell]`` is the adversary's action."""
    if step == horizon:
        return 0.0
    total = 0.0
    for action in range(5):
        probability = (1 - p) * policy[cell, action] + p * (chosen[step, cell] == action)
        if probability:
            to = moved(cell, action, size)
            total += probability * ((to == goal) + value_against(policy, chosen, p, goal, size, horizon, to, step + 1))
    return total


def variation(goal, size, horizon, start=(0, 0)):
    return Variation(room.task(goal, size, horizon, start), NULL)


def random_policy(rng, cells):
    return rng.dirichlet(np.ones(5), size=cells)


@pytest.mark.parametrize("p", [0.1, 0.5, 1.0])
def test_no_adversary_of_all_does_worse(p):
    rng = np.random.default_rng(0)
    policy = random_policy(rng, 4)
    # The first choice matters in the start cell only; the second in each of the four cells.
    lowest = np.inf
    for first, *second in itertools.product(range(5), repeat=5):
        chosen = np.array([[first] * 4, second])
        lowest = min(lowest, value_against(policy, chosen, p, 3, 2, 2, 0))
    assert worst_case(policy, variation((1, 1), 2, 2), p) == pytest.approx(lowest, abs=1e-12)


def test_a_3x3_room_against_a_slow_recursion():
    rng = np.random.default_rng(1)
    policy, goal, p = random_policy(rng, 9), (2, 1), 0.3
    value = [0.0] * 9
    for _ in range(6):
        arrived = [[float(moved(c, a, 3) == 7) + value[moved(c, a, 3)] for a in range(5)] for c in range(9)]
        value = [(1 - p) * sum(policy[c, a] * arrived[c][a] for a in range(5)) + p * min(arrived[c]) for c in range(9)]
    assert worst_case(policy, variation(goal, 3, 6), p) == pytest.approx(value[0], abs=1e-12)
    assert worst_case(policy, variation(goal, 3, 6, None), p) == pytest.approx(np.mean(value), abs=1e-12)


def test_without_disturbance_it_is_the_expected_return_and_the_best_policy_has_the_optimum():
    one = variation((1, 2), 3, 9)
    uniform = np.full((9, 5), 0.2)
    nobody = np.zeros((9, 9), int)
    assert worst_case(uniform, variation((1, 2), 3, 4), 0.0) == pytest.approx(value_against(uniform, nobody, 0, 5, 3, 4, 0))
    assert worst_case(None, one, 0.0) == pytest.approx(optimal_returns(Hypotheses.of([one]))[0])


def test_the_minimax_oracle_is_above_every_policy_and_below_every_weaker_adversary():
    rng = np.random.default_rng(2)
    best = [worst_case(None, variation((2, 2), 3, 9), p) for p in (0.0, 0.2, 0.6, 1.0)]
    assert best == sorted(best, reverse=True) and best[-1] == 0.0
    for _ in range(20):
        assert worst_case(random_policy(rng, 9), variation((2, 2), 3, 9), 0.2) <= best[1]
    uniform = Variation(room.task((2, 2), 3, 9, (0, 0)), Adversary.of("uniform", p=0.2))
    assert best[1] < optimal_returns(Hypotheses.of([uniform]))[0]


@pytest.mark.parametrize(
    ("policy", "p", "message"),
    [
        (np.full((9, 5), 0.2), 1.5, "p = 1.5"),
        (np.full((9, 5), 0.2), float("nan"), "p = nan"),
        (np.full((4, 5), 0.2), 0.1, r"\(4, 5\).*\(9, 5\)"),
        (np.full((9, 5), 0.3), 0.1, "distributions"),
        (np.full((9, 5), np.nan), 0.1, "distributions"),
    ],
)
def test_wrong_input_is_one_line(policy, p, message):
    with pytest.raises(ValueError, match=message):
        oracle.worst_case(policy, variation((1, 1), 3, 5), p)
