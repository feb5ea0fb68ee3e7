"""Statistics compared with obvious loops and with numbers that rliable computed (tools/rliable_golden.py)."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.results import statistics

GOLDEN = json.loads((Path(__file__).parent / "rliable.json").read_text())


@pytest.mark.parametrize("case", GOLDEN["cases"], ids=lambda case: f"{len(case['x'])}x{len(case['x'][0])}")
def test_numbers_are_those_of_rliable(case):
    x, y = np.array(case["x"]), np.array(case["y"])
    assert statistics.mean(x) == pytest.approx(case["mean"], abs=1e-12)
    assert statistics.iqm(x) == pytest.approx(case["iqm"], abs=1e-12)
    assert statistics.probability_of_improvement(x, y) == pytest.approx(case["probability_of_improvement"], abs=1e-12)


def test_the_golden_cases_have_ties_and_unequal_numbers_of_trainings():
    cases = [(np.array(case["x"]), np.array(case["y"])) for case in GOLDEN["cases"]]
    assert any((x[:, None] == y[None]).any() for x, y in cases)
    assert any(len(x) != len(y) for x, y in cases)


def slow_mean(scores):
    return sum(value for training in scores for value in training) / sum(map(len, scores))


def slow_iqm(scores):
    values = sorted(value for training in scores for value in training)
    cut = len(values) // 4
    kept = values[cut : len(values) - cut]
    return sum(kept) / len(kept)


def slow_minimum(scores):
    return sum(min(training) for training in scores) / len(scores)


def slow_improvement(x, y):
    cells = []
    for c in range(len(x[0])):
        wins = 0.0
        for one in x:
            for two in y:
                wins += 1.0 if one[c] > two[c] else 0.5 if one[c] == two[c] else 0.0
        cells.append(wins / (len(x) * len(y)))
    return sum(cells) / len(cells)


def slow_ratio(x, y):
    return slow_mean(x) / slow_mean(y) if slow_mean(y) > 0 else math.nan


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (3, 4), (4, 9)])
def test_each_statistic_equals_a_loop_for_every_element_of_a_batch(shape):
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 9, size=(2, 6, *shape)).astype(float)
    for fast, slow in ((statistics.mean, slow_mean), (statistics.iqm, slow_iqm), (statistics.minimum, slow_minimum)):
        np.testing.assert_allclose(fast(x), [slow(one) for one in x.tolist()])
    pairs = list(zip(x.tolist(), y.tolist(), strict=True))
    improvement, ratio = statistics.probability_of_improvement(x, y), statistics.ratio(x, y)
    np.testing.assert_allclose(improvement, [slow_improvement(*pair) for pair in pairs])
    np.testing.assert_allclose(ratio, [slow_ratio(*pair) for pair in pairs])


def test_a_ratio_to_nothing_is_not_a_number():
    assert np.isnan(statistics.ratio(np.ones((2, 2)), np.zeros((2, 2))))
    assert np.isnan(statistics.ratio(np.ones((2, 2)), -np.ones((2, 2))))


def test_the_standard_error_is_that_of_the_mean_and_unknown_for_one_value():
    values = [3.0, 5.0, 10.0]
    deviation = math.sqrt(sum((value - 6) ** 2 for value in values) / 2)
    assert statistics.standard_error(np.array(values)) == pytest.approx(deviation / math.sqrt(3))
    assert np.isnan(statistics.standard_error(np.array([[1.0, 2.0]]))).all()


def slow_bootstrap(scores, statistic, rng, count, crossed, fixed=False):
    """The bootstrap, one index at a time."""
    answer = []
    for chosen in statistics.resamples(rng, scores.shape[1:], count, crossed, fixed):
        rows = len(chosen.trainings), *scores.shape[1:]
        cells_of, evaluations = np.broadcast_to(chosen.cells, (*rows[:3], 1)), np.broadcast_to(chosen.evaluations, rows)
        for r in range(len(chosen.trainings)):
            agents = []
            for agent in scores:
                resample = []
                for i in range(scores.shape[1]):
                    training = agent[chosen.trainings[r, i, 0, 0]]
                    cells = []
                    for j in range(scores.shape[2]):
                        cell = training[j if fixed else cells_of[r, i, j, 0]]
                        drawn = [cell[evaluations[r, i, j, k]] for k in range(scores.shape[3])]
                        cells.append(sum(drawn) / len(drawn))
                    resample.append(cells)
                agents.append(resample)
            answer.append(statistic(*agents))
    return np.array(answer)


@pytest.mark.parametrize("crossed", [True, False])
@pytest.mark.parametrize("shape", [(1, 4, 2), (3, 4, 2), (2, 5, 1)])
def test_the_bootstrap_equals_loops_over_its_indices(monkeypatch, shape, crossed):
    monkeypatch.setattr(statistics, "_CHUNK", 7 * math.prod(shape))  # so that 50 resamples are several chunks
    scores = np.random.default_rng(1).normal(size=(2, *shape))

    def fast(drawn):
        return np.stack([statistics.mean(drawn[:, 0]), statistics.probability_of_improvement(drawn[:, 0], drawn[:, 1])], -1)

    found = statistics.bootstrap(scores, fast, np.random.default_rng(2), 50, crossed)
    slow = slow_bootstrap(scores, lambda x, y: (slow_mean(x), slow_improvement(x, y)), np.random.default_rng(2), 50, crossed)
    np.testing.assert_allclose(found, slow)


def test_resamples_are_drawn_evenly_and_crossed_ones_share_the_cells_of_all_trainings():
    (chosen,) = statistics.resamples(np.random.default_rng(0), (3, 4, 2), 5000, crossed=True)
    assert chosen.cells.shape == (5000, 1, 4, 1) and chosen.evaluations.shape == (5000, 3, 4, 2)
    for indices, count in zip(chosen, (3, 4, 2), strict=True):
        shares = np.bincount(indices.ravel(), minlength=count) / indices.size
        np.testing.assert_allclose(shares, 1 / count, atol=0.02)
    (nested,) = statistics.resamples(np.random.default_rng(0), (3, 4, 2), 5000, crossed=False)
    np.testing.assert_array_equal(nested.trainings, chosen.trainings)
    assert nested.cells.ravel().tolist() == [0, 1, 2, 3] and nested.evaluations.ravel().tolist() == [0, 1]


def test_pairs_share_their_resamples():
    first = np.random.default_rng(0).normal(size=(2, 5, 3)) * 100
    drawn = statistics.bootstrap(
        np.stack([first, first + 1]),
        lambda of: (statistics.mean(of[:, 1]) - statistics.mean(of[:, 0]))[:, None],
        np.random.default_rng(0),
    )
    np.testing.assert_allclose(drawn, 1)


STUDENT = {2: math.tan(0.475 * math.pi), 3: 0.95 / math.sqrt(2 * 0.975 * 0.025), 20: 2.093024}
"""0.975 quantiles of Student's t by the number of units: closed forms for one and two degrees of freedom."""


def slow_interval(value, values, units):
    """Bounds by a loop: the value +- t * standard deviation * sqrt(n / (n - 1))."""
    center = sum(values) / len(values)
    deviation = math.sqrt(sum((one - center) ** 2 for one in values) / (len(values) - 1))
    half = STUDENT[units] * deviation * math.sqrt(units / (units - 1))
    return value - half, value + half


@pytest.mark.parametrize("units", list(STUDENT))
def test_an_interval_is_students_with_the_bootstraps_standard_error(units):
    drawn = np.random.default_rng(0).normal(size=(50, 2)) / [1, 100]
    low, high = statistics.bounds(np.array([3.0, 5.0]), drawn, units)
    for k, value in enumerate((3.0, 5.0)):
        assert (low[k], high[k]) == pytest.approx(slow_interval(value, drawn[:, k].tolist(), units))


def test_an_interval_of_one_unit_or_of_anything_undefined_is_unknown():
    drawn = np.ones((50, 4))
    drawn[7, 1] = np.nan
    low, high = statistics.bounds(np.array([1.0, 1.0, np.nan, 1.0]), drawn, 5)
    for bound in (low, high):
        np.testing.assert_array_equal(bound, [1, np.nan, np.nan, 1])
    assert np.isnan(statistics.bounds(np.ones(4), drawn, 1)).all()


def test_a_probability_of_1_has_an_interval_and_no_bound_outside_of_0_to_1():
    for units, shown in ((2, False), (3, False), (4, True), (10, True)):
        low, high = statistics.bounds(np.array([1.0, 0.0]), np.tile([1.0, 0.0], (50, 1)), units, probability=True)
        assert high[0] == 1 and low[1] == 0 and (low[0] > 0.5) == (high[1] < 0.5) == shown and low[0] < 1


@pytest.mark.parametrize(
    ("shape", "units", "fixed"),
    [((3, 20, 5), 3, 3), ((1, 20, 5), 20, 5), ((1, 1, 5), 5, 5), ((1, 20, 1), 20, 1), ((1, 1, 1), 1, 1)],
)
def test_an_interval_is_over_the_uppermost_units_of_which_there_are_several(shape, units, fixed):
    assert (statistics.units(shape), statistics.units(shape, fixed_cells=True)) == (units, fixed)


def test_a_resample_of_fixed_cells_has_each_of_them_once():
    scores = np.arange(4.0).reshape(1, 1, 4, 1) * np.ones((1, 3, 1, 2))
    drawn = statistics.bootstrap(scores, lambda of: of[:, 0].reshape(len(of), -1), np.random.default_rng(0), 9, True, True)
    np.testing.assert_array_equal(drawn, np.tile(np.arange(4.0), (9, 3)))


def test_trainings_with_tasks_of_their_own_are_compared_with_their_partner_only():
    tasks = np.random.default_rng(0).normal(0, 100, size=(4, 20))
    assert statistics.probability_of_improvement(tasks + 1, tasks, crossed=False) == 1
    assert 0.4 < statistics.probability_of_improvement(tasks + 1, tasks) < 1
    assert statistics.probability_of_improvement(tasks, tasks, crossed=False) == 0.5


@pytest.mark.parametrize(("trainings", "tasks", "evaluations"), [(1, 20, 4), (3, 10, 2), (8, 10, 2)])
def test_intervals_cover_the_true_mean_about_as_often_as_they_should(monkeypatch, trainings, tasks, evaluations):
    """Returns with variance between trainings, between tasks that all trainings share, and between evaluations.

    With few trainings the interval is too wide, because Student's t also multiplies the error of the many tasks.
    """
    monkeypatch.setattr(statistics, "RESAMPLES", 200)
    rng, covered, runs = np.random.default_rng(0), 0, 300
    between = 1.0 if trainings > 1 else 0.0  # one training: the interval is conditional on it
    for _ in range(runs):
        training = between * rng.normal(size=(trainings, 1, 1))
        scores = training + rng.normal(size=(1, tasks, 1)) + rng.normal(size=(trainings, tasks, evaluations))
        (found,) = statistics.estimate(scores[None], statistics.mean)
        covered += found.low <= 0 <= found.high
    assert 0.92 < covered / runs <= (0.99 if trainings != 3 else 1)


@pytest.mark.parametrize(("trainings", "least", "most"), [(5, 0.9, 0.985), (10, 0.92, 0.985)])
@pytest.mark.parametrize("own_tasks", [True, False])
@pytest.mark.parametrize("components", [(1.0, 1.0, 1.0), (0.5, 3.0, 2.0), (2.0, 1.0, 1.0)])
def test_intervals_over_trainings_tasks_and_adversary_draws_are_right(
    monkeypatch, trainings, least, most, own_tasks, components
):
    """Standard deviations between trainings, tasks and adversary draws, which are nested, or tasks that all trainings share.

    To draw tasks of their own again within each drawn training made intervals 35% too wide where tasks differ most.
    """
    monkeypatch.setattr(statistics, "RESAMPLES", 150)
    rng, covered, runs = np.random.default_rng(trainings), 0, 300
    of_training, of_task, of_draw = components
    for _ in range(runs):
        scores = of_training * rng.normal(size=(trainings, 1, 1))
        scores = scores + of_task * rng.normal(size=(trainings if own_tasks else 1, 20, 1))
        scores = scores + of_draw * rng.normal(size=(trainings, 20, 4))
        (found,) = statistics.estimate(scores[None], statistics.mean, crossed=not own_tasks)
        covered += found.low <= 0 <= found.high
    assert least <= covered / runs <= (most if own_tasks else 1)


@pytest.mark.parametrize("noise", [1.0, 0.1])
def test_equal_methods_of_three_trainings_are_seldom_called_different(monkeypatch, noise):
    """The nominal rate is 5%.  Percentile intervals gave 22%, and without its least error the probability gave 10%."""
    monkeypatch.setattr(statistics, "RESAMPLES", 200)
    rng, runs = np.random.default_rng(0), 200

    def difference(of):
        return (statistics.mean(of[:, 1]) - statistics.mean(of[:, 0]))[:, None]

    def improvement(of):
        return statistics.probability_of_improvement(of[:, 1], of[:, 0])[:, None]

    wrong = np.zeros(2)
    for _ in range(runs):
        shared = rng.normal(size=(1, 1, 20, 1))
        scores = shared + rng.normal(size=(2, 3, 1, 1)) + noise * rng.normal(size=(2, 3, 20, 5))
        (mean,) = statistics.estimate(scores, difference)
        (better,) = statistics.estimate(scores, improvement, probability=True)
        wrong += [mean.verdict() != "not shown", better.verdict(0.5) != "not shown"]
    assert (wrong / runs <= 0.08).all()


def test_a_caption_says_what_was_resampled():
    assert statistics.resampled(3, 20, 2, 5) == (
        "95% interval over 3 training seeds, 20 tasks with their adversaries, 2 evaluations of each, 5 episodes an evaluation"
    )
    assert statistics.resampled(3, 20, 4, 5, draws=4) == (
        "95% interval over 3 training seeds, 20 tasks, 4 evaluations of each with an adversary draw of its own, "
        "5 episodes an evaluation"
    )
    assert statistics.resampled(1, 20, 4, draws=4).endswith("draw of its own; it says nothing about other training seeds")
    one = statistics.resampled(1, 1, 2)
    assert one.startswith("one training: 95% interval over 1 task with its adversary, 2 evaluations of each; ")
    assert one.endswith("it says nothing about other training seeds")
    assert statistics.resampled(1, 1, 1) == "one training, one evaluation of one task: no intervals"


def test_one_training_draws_nothing_for_the_level_of_trainings():
    """So intervals of a single training are those of a bootstrap over its tasks, or over the evaluations of fixed tasks."""
    one, two = (generator(0, RandomKey.RESULTS) for _ in range(2))
    (chosen,) = statistics.resamples(one, (1, 4, 2), 10, crossed=True)
    np.testing.assert_array_equal(chosen.cells[:, 0, :, 0], two.integers(0, 4, size=(10, 4)))
    assert chosen.evaluations.ravel().tolist() == [0, 1]
    for shape, fixed in (((1, 4, 2), True), ((1, 1, 2), False)):
        (chosen,) = statistics.resamples(one, shape, 10, crossed=True, fixed_cells=fixed)
        assert chosen.evaluations.shape == (10, *shape) and set(chosen.evaluations.ravel()) == {0, 1}


@pytest.mark.parametrize(("of_task", "of_evaluation"), [(1.0, 1.0), (0.3, 2.0), (0.0, 1.0)])
def test_intervals_of_one_training_count_the_noise_of_evaluations_once(monkeypatch, of_task, of_evaluation):
    """With evaluations drawn again in each drawn task, intervals covered up to 98.7% and were up to 35% too wide."""
    monkeypatch.setattr(statistics, "RESAMPLES", 200)
    rng, covered, runs = np.random.default_rng(0), 0, 600
    for _ in range(runs):
        scores = of_task * rng.normal(size=(1, 20, 1)) + of_evaluation * rng.normal(size=(1, 20, 4))
        (found,) = statistics.estimate(scores[None], statistics.mean)
        covered += found.low <= 0 <= found.high
    assert 0.925 < covered / runs < 0.965
