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


def slow_bootstrap(scores, statistic, rng, count, crossed):
    """The bootstrap, one index at a time."""
    answer = []
    for chosen in statistics.resamples(rng, scores.shape[1:], count, crossed):
        for r in range(len(chosen.trainings)):
            agents = []
            for agent in scores:
                resample = []
                for i in range(scores.shape[1]):
                    training = agent[chosen.trainings[r, i, 0, 0]]
                    cells = []
                    for j in range(scores.shape[2]):
                        cell = training[chosen.cells[r, 0 if crossed else i, j, 0]]
                        drawn = [cell[chosen.evaluations[r, i, j, k]] for k in range(scores.shape[3])]
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
    low, high = statistics.interval(found)
    for k in range(2):
        values = sorted(slow[:, k])
        for bound, share in ((low[k], 0.025), (high[k], 0.975)):  # linear interpolation between order statistics
            place = share * (len(values) - 1)
            below = math.floor(place)
            assert bound == pytest.approx(values[below] + (place - below) * (values[min(below + 1, 49)] - values[below]))


def test_resamples_are_drawn_evenly_and_crossed_ones_share_the_cells_of_all_trainings():
    (chosen,) = statistics.resamples(np.random.default_rng(0), (3, 4, 2), 5000, crossed=True)
    assert chosen.cells.shape == (5000, 1, 4, 1) and chosen.evaluations.shape == (5000, 3, 4, 2)
    for indices, count in zip(chosen, (3, 4, 2), strict=True):
        shares = np.bincount(indices.ravel(), minlength=count) / indices.size
        np.testing.assert_allclose(shares, 1 / count, atol=0.02)
    (nested,) = statistics.resamples(np.random.default_rng(0), (3, 4, 2), 5000, crossed=False)
    assert nested.cells.shape == (5000, 3, 4, 1)


def test_pairs_share_their_resamples():
    first = np.random.default_rng(0).normal(size=(2, 5, 3)) * 100
    drawn = statistics.bootstrap(
        np.stack([first, first + 1]),
        lambda of: (statistics.mean(of[:, 1]) - statistics.mean(of[:, 0]))[:, None],
        np.random.default_rng(0),
    )
    np.testing.assert_allclose(drawn, 1)


def test_intervals_leave_out_what_is_undefined():
    values = np.stack([np.arange(100.0), np.full(100, np.nan), np.r_[np.nan, np.arange(99.0)]], axis=1)
    low, high = statistics.interval(values)
    np.testing.assert_allclose(low, [2.475, np.nan, 2.45])
    np.testing.assert_allclose(high, [96.525, np.nan, 95.55])


@pytest.mark.parametrize(("trainings", "tasks", "evaluations"), [(1, 20, 4), (8, 10, 2)])
def test_intervals_cover_the_true_mean_about_as_often_as_they_should(trainings, tasks, evaluations):
    """Returns with variance between trainings, between tasks that all trainings share, and between evaluations."""
    rng, covered, runs = np.random.default_rng(0), 0, 300
    between = 1.0 if trainings > 1 else 0.0  # one training: the interval is conditional on it
    for _ in range(runs):
        training = between * rng.normal(size=(trainings, 1, 1))
        scores = training + rng.normal(size=(1, tasks, 1)) + rng.normal(size=(trainings, tasks, evaluations))
        drawn = statistics.bootstrap(scores[None], statistics.mean, np.random.default_rng(0), 300)
        low, high = statistics.interval(drawn)
        covered += bool(low[0] <= 0 <= high[0])
    assert 0.87 < covered / runs <= 0.99


def test_a_caption_says_what_was_resampled():
    assert statistics.resampled(3, 20, 2, 5) == (
        "95% interval over 3 training seeds, 20 tasks with their adversaries, 2 evaluations of each, 5 episodes an evaluation"
    )
    one = statistics.resampled(1, 1, 1)
    assert one.startswith("one training: 95% interval over 1 task with its adversary, 1 evaluation of each; ")
    assert one.endswith("it says nothing about other training seeds")


def test_one_training_draws_nothing_for_the_level_of_trainings():
    """So intervals of a single training are those of a bootstrap over its tasks and evaluations alone."""
    one, two = (generator(0, RandomKey.RESULTS) for _ in range(2))
    (chosen,) = statistics.resamples(one, (1, 4, 2), 10, crossed=True)
    np.testing.assert_array_equal(chosen.cells[:, 0, :, 0], two.integers(0, 4, size=(10, 4)))
    np.testing.assert_array_equal(chosen.evaluations[:, 0], two.integers(0, 2, size=(10, 4, 2)))
