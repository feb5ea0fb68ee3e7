"""RARL's alternation and QARL's curriculum against slow loops, and the teacher's update against scipy's optimum."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import integrate, optimize, stats
from scipy.special import digamma, gammaln

from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.adversarial import curriculum, schedule
from icrl_dist.experts.adversarial.curriculum import Curriculum
from icrl_dist.types import Spec

SPEC = Spec((-1.0, -2.0), (1.0, 2.0), 1, 5, discrete=False)


def test_the_players_learn_in_turn_the_adversary_first() -> None:
    config = RobustConfig(adversary_episodes=2, protagonist_episodes=3)
    sac = SACConfig(steps=5 * 3 * 4 + 7)
    slow: list[str] = []
    for _ in range(4):
        slow += ["adversary"] * 2 + ["protagonist"] * 3
    found = [schedule.learner(episode, config) for episode in range(schedule.episodes(5, sac, config))]
    assert found == slow
    assert found.count("protagonist") * 5 <= sac.steps < (found.count("protagonist") + 3) * 5
    assert schedule.episodes(5, SACConfig(steps=1), config) == 5, "at least one iteration"


def test_the_default_is_200_iterations_of_5_and_5_episodes() -> None:
    assert schedule.episodes(200, SACConfig(), RobustConfig()) == 200 * 10


def general_divergence(shape: float, rate: float, other_shape: float, other_rate: float) -> float:
    """KL divergence of two Gamma distributions of any rates."""
    shapes = (shape - other_shape) * digamma(shape) - gammaln(shape) + gammaln(other_shape)
    return float(shapes + other_shape * math.log(rate / other_rate) + shape * (other_rate - rate) / rate)


@pytest.mark.parametrize(("shape", "other"), [(50.0, 40.0), (3.0, 7.0), (1.0, 2.0), (4.0, 4.0)])
def test_the_divergence_is_the_integral(shape: float, other: float) -> None:
    p, q = stats.gamma(shape), stats.gamma(other)
    slow, _ = integrate.quad(lambda x: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), 0, 200, limit=200)
    assert curriculum.divergence(shape, other) == pytest.approx(slow, abs=1e-6)
    assert curriculum.divergence(shape, other) == pytest.approx(general_divergence(shape, 1000.0, other, 1000.0))


@pytest.mark.parametrize(("old", "target", "most"), [(50.0, 1.0, 0.5), (20.0, 1.0, 0.1), (3.0, 1.0, 0.5), (2.0, 9.0, 0.3)])
def test_the_teachers_update_is_scipys_optimum_over_concentration_and_rate(old: float, target: float, most: float) -> None:
    """The rate is free in scipy's problem: that it stays is a result, not a restriction."""
    rate = 1000.0
    minimize: Any = optimize.minimize  # its stubs know fewer forms of constraints
    best = minimize(
        lambda x: general_divergence(math.exp(x[0]), math.exp(x[1]), target, rate),
        [math.log(old), math.log(rate)],
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda x: most - general_divergence(math.exp(x[0]), math.exp(x[1]), old, rate)},
        options={"ftol": 1e-10, "maxiter": 500},
    )
    assert best.success
    new = curriculum.moved(old, target, most)
    assert new == pytest.approx(math.exp(best.x[0]), rel=1e-4) and math.exp(best.x[1]) == pytest.approx(rate, rel=1e-4)
    assert curriculum.divergence(new, target) <= float(best.fun) + 1e-6
    assert curriculum.divergence(new, old) == pytest.approx(most)


def test_the_target_is_reached_and_kept() -> None:
    path, updates = 50.0, 0
    while path != 1.0:
        before, path = path, curriculum.moved(path, 1.0, 0.5)
        assert path < before
        updates += 1
    assert updates == 13 and curriculum.moved(1.0, 1.0, 0.5) == 1.0


def test_each_task_moves_when_its_own_mean_return_holds_its_bound() -> None:
    config, bounds = RobustConfig(teacher_episodes=3), np.array([0.0, 2.2, 5.0])
    teacher, rng = Curriculum(config, bounds), np.random.default_rng(0)
    slow, seen = [50.0] * 3, list[np.ndarray]()
    for episode in range(30):
        returns = rng.uniform(0.0, 4.5, 3)
        teacher.observe(returns)
        seen.append(returns)
        if episode % 3 == 2:
            for row in range(3):
                if sum(one[row] for one in seen) / 3 >= bounds[row]:
                    slow[row] = curriculum.moved(slow[row], 1.0, 0.5)
            seen = []
        np.testing.assert_allclose(teacher.concentrations, slow)
    assert 1.0 <= slow[0] < slow[1] < slow[2] == 50.0, "always, at some updates, never"
    again = Curriculum(config, bounds)
    again.load(teacher.state())
    for one in (teacher, again):
        one.observe(np.full(3, 9.0))
    np.testing.assert_array_equal(again.concentrations, teacher.concentrations)


def test_temperatures_follow_the_gamma_distribution_and_are_clipped() -> None:
    count = 4000
    teacher = Curriculum(RobustConfig(most_temperature=0.055), np.zeros(count))
    drawn = teacher.temperatures([np.random.default_rng((7, row)) for row in range(count)])
    expected = stats.gamma(50, scale=1 / 1000)
    assert drawn.max() == np.float32(0.055) and drawn.min() >= 0
    assert np.mean(drawn == drawn.max()) == pytest.approx(expected.sf(0.055), abs=0.02)
    assert np.quantile(drawn, [0.1, 0.5]) == pytest.approx(expected.ppf([0.1, 0.5]), rel=0.02)
    alone = Curriculum(RobustConfig(most_temperature=0.055), np.zeros(1)).temperatures([np.random.default_rng((7, 9))])
    assert alone[0] == drawn[9], "a task's draws do not depend on the others"


def test_temperature_is_the_last_component_and_0_is_in_its_range() -> None:
    spec = curriculum.with_temperature(SPEC, RobustConfig())
    assert (spec.observation, spec.low, spec.actions, spec.horizon) == (3, (-1.0, -2.0, 0.0), 1, 5)
    assert spec.low[-1] <= 0.0 < spec.high[-1]
    observation = np.arange(6, dtype=np.float32).reshape(3, 2)
    at_test = curriculum.appended(observation)
    np.testing.assert_array_equal(at_test[:, :2], observation)
    assert not at_test[:, 2].any() and at_test.dtype == np.float32
    np.testing.assert_array_equal(
        curriculum.appended(observation, np.array([0.1, 0.2, 0.3]))[:, 2], np.array([0.1, 0.2, 0.3], np.float32)
    )


def test_returns_are_discounted_from_the_first_step() -> None:
    rewards = np.random.default_rng(1).random((2, 3, 6))
    slow = np.zeros((2, 3))
    for row, column, step in np.ndindex(2, 3, 6):
        slow[row, column] += 0.9**step * rewards[row, column, step]
    np.testing.assert_allclose(curriculum.discounted(rewards, 0.9), slow)
