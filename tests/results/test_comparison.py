"""Which rows are compared, what is refused, and when a difference is called one."""

from __future__ import annotations

import json
import math

import numpy as np
import pandas as pd
import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.results import summaries, tables
from icrl_dist.results.comparison import Comparison, compare, newest_model
from icrl_dist.results.returns import returns
from icrl_dist.results.statistics import Interval
from tests.results.row_blocks import block, cells_of, frame, rendered, unwrapped


def test_an_effect_is_worded_by_its_interval():
    def verdict(low, high, neutral=0.0):
        return Comparison(0.0, "mean", 1.0, 2.0, Interval((low + high) / 2, low, high), neutral).verdict

    assert [verdict(0.1, 2), verdict(-2, -0.1), verdict(-1, 2), verdict(0, 2)] == ["higher", "lower", "not shown", "not shown"]
    assert [verdict(0.4, 0.9, 0.5), verdict(0.6, 0.9, 0.5), verdict(math.nan, math.nan)] == ["not shown", "higher", "not shown"]


def test_one_training_makes_no_claim_over_seeds():
    text = rendered(tables.compare(frame(block([[[1.0]], [[2.0]]])), frame(block([[[3.0]], [[5.0]]]))))
    assert "one training: 95% interval over 2 tasks" in unwrapped(text)
    assert "it says nothing about other training seeds" in unwrapped(text) and "higher" not in text


def test_one_evaluation_is_no_evidence():
    one, other = frame(block([[[1.0]]])), frame(block([[[1.1]]]))
    _, body = cells_of(rendered(tables.compare(one, other)))
    assert [cells[5:] for cells in body[:3]] == [["+0.10", "-", "not shown"]] * 3
    assert {cells[7] for cells in body} == {"not shown"}
    (row,) = summaries.result_rows(one)
    assert row["last5"] == 1.0 and row["last5_interval"] == [None, None]
    assert "no intervals" in unwrapped(rendered(tables.returns_table(one, "")))


TWO = [[[1.0, 2.0]], [[3.0, 4.0]]]


DRAWS = np.tile(np.repeat(['{"draw": 0}', '{"draw": 1}'], 2), 2).astype(object)


def test_pairs_with_another_adversary_in_one_evaluation_are_refused():
    grid = [[[1.0, 2.0]] * 2] * 2
    other = DRAWS.copy()
    other[6:] = '{"draw": 7}'  # the second evaluation of the second task
    with pytest.raises(ConfigError, match=r'task 1: .* in evaluation 1 adversary null \{"draw": 1\} and .*"draw": 7\}: pairs'):
        tables.compare(frame(block(grid, adversary=DRAWS)), frame(block(grid, adversary=other)))
    assert "not shown" in rendered(tables.compare(frame(block(grid, adversary=DRAWS)), frame(block(grid, adversary=DRAWS))))


def test_a_table_says_whether_evaluations_have_adversary_draws_of_their_own():
    grid = [[[1.0, 2.0]] * 2] * 2
    drawn, alike = (
        unwrapped(rendered(tables.returns_table(frame(of), ""))) for of in (block(grid, adversary=DRAWS), block(grid))
    )
    assert "2 tasks, 2 evaluations of each with an adversary draw of its own" in drawn
    assert "2 tasks with their adversaries, 2 evaluations of each" in alike


def test_the_worst_sampled_adversary_is_the_lowest_of_each_task():
    grid = [[[4.0], [2.0], [9.0]], [[5.0], [6.0], [1.0]]]
    draws = np.array(['{"q": 0}', '{"q": 1}', '{"q": 1}'] * 2, object)
    (found,) = returns(frame(block(grid, adversary=draws)))
    assert found.draws == 2 and found.worst_sampled() == (4.0 + 3.5) / 2
    (alike,) = returns(frame(block(grid)))
    assert alike.draws == 1 and alike.worst_sampled() == (5.0 + 4.0) / 2, "one adversary: its mean, not the lowest episode"


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (block(TWO, seed=1), r"training seeds are \(0,\) .* and \(1,\)"),
        (block([[[1.0, 2.0]] * 2] * 2), r"evaluation seeds are \(0,\) .* and \(0, 1\)"),
        (block([[[1.0]], [[2.0]]]), r"episodes are 2 .* and 1"),
        (block(TWO[:1]), r"tasks are 2 .* and 1"),
        (block(TWO, split_seed=3), r"training seed 0, task 0: .*split seed 0, .*split seed 3"),
        (block(TWO, adversary='{"p": 0.1}'), r"pairs need equal split seed, task and adversary"),
        (block(TWO, task='{"goal": 9}'), r'task \{"goal": 9\}'),
        (block(TWO, p=0.2), r"evaluated at no p in common"),
    ],
)
def test_rows_that_cannot_be_paired_are_refused(other, expected):
    with pytest.raises(ConfigError, match=expected) as refused:
        tables.compare(frame(block(TWO)), frame(other))
    assert "\n" not in str(refused.value)


def test_rows_that_are_no_full_grid_are_refused():
    whole = frame(block(TWO))
    with pytest.raises(ConfigError, match=r"t0, p = 0: 3 rows for 1 trainings, 2 tasks, 1 evaluations and 2 episodes"):
        tables.returns_table(whole.iloc[:3], "")
    with pytest.raises(ConfigError, match="choose rows of runs with different seeds"):
        tables.returns_table(frame(block(TWO), block(TWO, run="same-seed")), "")
    for column, values in (("prior", ("uniform", "unseen")), ("suite", ("online", "offline")), ("tasks", ("test", "train"))):
        mixed = pd.concat([whole.assign(**{column: value}) for value in values])
        with pytest.raises(ConfigError, match=f"{column} is {', '.join(values)}; choose one"):
            tables.returns_table(mixed, "")
    with pytest.raises(ConfigError, match="training seed 0, t0: weights_digest is old, new; choose rows"):
        tables.returns_table(frame(block(TWO, weights_digest="old"), block(TWO, p=0.2, weights_digest="new")), "")
    with pytest.raises(ConfigError, match="episode is 1 to 1, 1 numbers, where it should be 0 to 0"):
        tables.returns_table(whole[whole.episode == 1], "")
    with pytest.raises(ConfigError, match="evaluation_seed is 0 to 2, 2 numbers, where it should be 0 to 1"):
        three = frame(block([[[1.0]] * 3]))
        tables.returns_table(three[three.evaluation_seed != 1], "")
    with pytest.raises(ConfigError, match="method is dpt, icaa; choose one"):
        tables.returns_table(frame(block(TWO), block(TWO, "t1", method="icaa")), "")
    with pytest.raises(ConfigError, match="there are none"):
        tables.returns_table(whole.iloc[:0], "")
    with pytest.raises(ConfigError, match="needs one agent of these: random, oracle"):
        tables.compare(frame(block(TWO, "random"), block(TWO, "oracle")), whole)


def test_the_newest_model_is_compared_by_the_rule_that_it_was_trained_for():
    blocks = [block([[[value]]], "t3", deployment=rule) for value, rule in ((5.0, "committed"), (1.0, "paper"))]
    text = rendered(tables.compare(frame(block([[[4.0]]], "t0")), frame(block([[[2.0]]], "t0"), *blocks)))
    assert cells_of(text)[1][0][3:5] == ["T^3 (dpt)", "5.00"]


def test_every_training_must_have_the_newest_model():
    old = [block(TWO, "t1", seed=seed) for seed in (0, 1)]
    with pytest.raises(
        ConfigError, match=r"needs t2, the newest model, of every training: at p = 0 there is none of .* seed 1;"
    ):
        tables.compare(frame(*old), frame(block(TWO, "t2", seed=0), *old))
    with pytest.raises(ConfigError, match=r"at p = 0.2 there is none of training seed 1;"):
        tables.compare(frame(*old), frame(*old, block(TWO, "t1", 0.2)))


def test_methods_are_compared_in_one_suite_and_with_one_kind_of_data():
    offline = frame(block(TWO, data="random"), block(TWO, data="expert"), suite="offline")
    with pytest.raises(ConfigError, match=r"one kind of offline data of these: expert, random; .*frame.data == 'expert'"):
        tables.compare(offline, offline)
    random, expert = (offline[offline.data == data] for data in ("random", "expert"))
    assert "not shown" in rendered(tables.compare(random, random))
    for other, expected in (
        (random, r"suite are online of .* and offline"),
        (frame(block(TWO, tasks="test")), r"tasks are evaluated of .* and test"),
        (frame(block(TWO, prior="unseen")), r"prior are uniform of .* and unseen"),
        (frame(block(TWO, problem="dmc-hopper-hop")), r"problem are darkroom of .* and dmc-hopper-hop"),
    ):
        with pytest.raises(ConfigError, match=expected):
            tables.compare(frame(block(TWO)), other)
    with pytest.raises(ConfigError, match=r"one kind of offline data: data are random and expert"):
        tables.compare(random, expert)


def test_agents_of_one_table_are_paired_row_by_row():
    with pytest.raises(ConfigError, match=r"training seeds are \(0,\) of .* and \(1,\) of"):
        tables.returns_table(frame(block(TWO, "t1"), block(TWO, "t2", seed=1)), "")
    with pytest.raises(ConfigError, match=r"task 0: T\^0 \(dpt\) has .*goal.* and random has"):
        tables.returns_table(frame(block(TWO), block(TWO, "random", task='{"goal": 9}')), "")


def test_a_share_is_one_of_the_agents_own_optimum():
    blocks = (block(TWO, "t1", optimum=[2.0, 2.0]), block(TWO, "t2", optimum=[10.0, 10.0]))
    _, body = cells_of(rendered(tables.returns_table(frame(*blocks), "")))
    assert [cells[-1].split()[0] for cells in body] == ["125%", "25%"]


def test_a_ratio_to_returns_that_may_be_0_has_no_verdict():
    first, second = (frame(block([[[one]] for one in values])) for values in ((0.0, 3.0, 0.0), (1.0, 8.0, 2.0)))
    rows = {row.statistic: row for row in compare(newest_model(first)[0], newest_model(second)[0])}
    assert rows["ratio"].effect.value == pytest.approx(8 / 3) and math.isnan(rows["ratio"].effect.low)
    assert rows["ratio"].verdict == "not shown"
    losses = frame(block([[[-1.0]], [[-2.0]]], optimum=[-1.0, -1.0]))
    (row,) = summaries.result_rows(losses)
    assert row["last5_over_optimum"] is None
    (found,) = returns(losses)
    assert summaries.first_over(found, found, 1) is None and summaries.episode_of(found, found, 0.9) is None


def test_the_minimum_keeps_its_tasks():
    """One task of 20 fails: a resample of tasks lacks it in 36% of the draws, although nothing about it is uncertain."""
    good = np.tile([[[10.0], [10.1]]], (20, 1, 1))
    bad = good.copy()
    bad[3] = 0
    rows = compare(newest_model(frame(block(good)))[0], newest_model(frame(block(bad)))[0])
    worst = next(row for row in rows if row.statistic == "minimum")
    assert worst.effect.value == pytest.approx(-10.05) and worst.verdict == "lower" and worst.effect.high < -9


def test_trainings_with_splits_of_their_own_are_compared_task_by_task():
    def method(shift):
        blocks = []
        for seed in range(4):
            hard = np.random.default_rng(seed).normal(0, 100, size=(20, 1, 1)) * np.ones((20, 2, 3))
            own = block(hard + shift, seed=seed, split_seed=seed)
            blocks.append(
                {**own, "task": np.array([json.dumps({"goal": int(100 * seed + i)}) for i in own["task_index"]], object)}
            )
        return newest_model(frame(*blocks))[0]

    first, second = method(0), method(1)
    assert not first.crossed
    *_, improvement = compare(first, second)
    assert improvement.effect.value == 1 and improvement.verdict == "higher"


def test_frames_that_no_table_can_show_are_refused():
    own = frame(block(TWO, p=None), suite="label_quality")
    for show in (lambda: tables.returns_table(own, ""), lambda: tables.compare(own, own)):
        with pytest.raises(ConfigError, match=r"suite label_quality have no p, .*choose rows of another suite"):
            show()
    unequal = frame(block([[[1.0, 2.0, 3.0]]]), block([[[1.0]]], p=0.2))
    for show in (lambda: tables.returns_table(unequal, ""), lambda: tables.compare(unequal, unequal)):
        with pytest.raises(ConfigError, match=r"at p = 0 has .* 3 episodes, and .* at p = 0.2 has .* 1 episodes; choose rows"):
            show()
    one = frame(block(TWO))
    for names in (("a",), ("a", "b", "c")):
        with pytest.raises(ConfigError, match=f"{len(names)} names were given for 2 frames"):
            tables.compare(one, one, names=names)
