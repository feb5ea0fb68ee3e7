"""Which goals and adversaries are trained on, and which are kept for the test."""

from __future__ import annotations

import dataclasses

import pytest

from icrl_dist.config.run import Run
from icrl_dist.problems import registry, splits
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld.environment import ml1_tasks
from icrl_dist.types import NULL


def with_room(run: Run, **values: object) -> Run:
    return dataclasses.replace(run, darkroom=dataclasses.replace(run.darkroom, **values))


@pytest.mark.parametrize(("size", "train"), [(10, 80), (3, 7), (5, 20)])
def test_split_is_disjoint_and_complete(small_run: Run, size: int, train: int) -> None:
    parts = splits.split(with_room(small_run, size=size))
    assert (len(parts.train), len(parts.test)) == (train, size * size - train)
    goals = [t["goal"] for t in parts.train + parts.test]
    assert sorted(goals) == [(x, y) for x in range(size) for y in range(size)]
    assert {t["horizon"] for t in parts.train + parts.test} == {8}
    assert all("start" not in dict(t.params) for t in parts.train), "training episodes start anywhere"


def test_split_repeats_and_follows_its_own_seed_only(small_run: Run) -> None:
    big = with_room(small_run, size=10)
    assert splits.split(big) == splits.split(dataclasses.replace(big, seed=7)), "the run's seed must not move the split"
    held_out = [frozenset(splits.split(with_room(big, split_seed=seed)).test) for seed in range(5)]
    assert len(set(held_out)) == 5
    # Shuffled, not the last rows of the room.
    assert {t["goal"][0] for t in held_out[0]} != {8, 9}  # type: ignore[index]


def test_train_fraction_decides_the_cut(small_run: Run) -> None:
    half = splits.split(with_room(small_run, size=4, train_fraction=0.5))
    assert (len(half.train), len(half.test)) == (8, 8)


def test_deployed_starts_in_the_origin_and_changes_nothing_else(small_run: Run) -> None:
    task = splits.split(small_run).test[0]
    there = splits.deployed(task)
    assert there["start"] == (0, 0)
    assert {k: v for k, v in there.params if k != "start"} == dict(task.params)
    assert {tuple(registry.make(splits.Variation(there)).reset(seed=seed)[0]) for seed in range(8)} == {(0, 0)}


def test_variations_are_the_tasks_own_and_repeat(small_run: Run) -> None:
    train = splits.split(small_run).train
    every = [splits.variations(small_run, i, t) for i, t in enumerate(train)]
    assert every == [splits.variations(small_run, i, t) for i, t in enumerate(train)]
    assert all([v.task for v in vs] == [t] * small_run.adversary.count for vs, t in zip(every, train, strict=True))
    assert all(vs[0].adversary == NULL for vs in every)
    drawn = [v.adversary for vs in every for v in vs[1:]]
    assert len(set(drawn)) == len(drawn), "two tasks share an adversary"
    other = splits.variations(dataclasses.replace(small_run, seed=1), 0, train[0])
    assert not {v.adversary for v in other[1:]} & set(drawn)
    assert max(a.number("p") for a in drawn) <= small_run.adversary.p_max


@pytest.mark.parametrize("prior", ["unseen", "uniform"])
def test_test_adversaries_differ_from_every_training_adversary(small_run: Run, prior: str) -> None:
    train = splits.split(small_run).train
    seen = {v.adversary for i, t in enumerate(train) for v in splits.variations(small_run, i, t)}
    alphas = {a.vector("alpha") for a in seen - {NULL}}
    for index in range(20):
        for p in (0.1, 0.2):
            one = splits.test_adversary(small_run, index, p, prior)
            assert one not in seen
            assert one.number("p") == p
            assert prior == "uniform" or one.vector("alpha") not in alphas


def test_test_adversaries_repeat_and_keep_their_law_as_p_grows(small_run: Run) -> None:
    weak, strong = (splits.test_adversary(small_run, 3, p, "unseen") for p in (0.1, 0.6))
    assert weak == splits.test_adversary(small_run, 3, 0.1, "unseen")
    assert weak.vector("alpha") == strong.vector("alpha")
    assert len({splits.test_adversary(small_run, i, 0.1, "unseen") for i in range(20)}) == 20
    assert splits.test_adversary(small_run, 3, 0.1, "uniform").kind == "uniform"
    assert splits.test_adversary(small_run, 3, 0.0, "unseen") == NULL


def test_a_continuous_run_trains_on_the_centre_and_tests_elsewhere(small_run: Run) -> None:
    control = dataclasses.replace(small_run.control, train_tasks=4, test_tasks=6, horizon=50, forces="qarl", strength=2.0)
    run = dataclasses.replace(small_run, problem="dmc-hopper-hop", control=control)
    parts = splits.split(run)
    assert (len(parts.train), len(parts.test)) == (4, 6) and not set(parts.train) & set(parts.test)
    masses = {task.number("torso_mass") for task in domains.grid(run.problem, 2)}
    assert {task.number("torso_mass") for task in parts.train} == masses
    assert {(t["horizon"], t["forces"]) for t in parts.train + parts.test} == {(50, "qarl")}
    assert parts == splits.split(dataclasses.replace(run, seed=7)), "the run's seed must not move the split"
    assert splits.spec(run) == registry.spec(parts.test[0]) and splits.disturbance(run) == 2
    kinds = splits.variations(run, 1, parts.train[1])
    assert kinds[0].adversary == NULL and len({v.adversary for v in kinds}) == run.adversary.count
    assert {v.adversary["strength"] for v in kinds[1:]} == {2.0}
    assert kinds != splits.variations(run, 1, parts.train[1], 1) and kinds == splits.variations(run, 1, parts.train[1])
    tests = [splits.test_adversary(run, i, 0.5, "unseen") for i in range(6)]
    assert (
        len(set(tests)) == 6 and {a["strength"] for a in tests} == {1.0} and splits.test_adversary(run, 0, 0, "unseen") == NULL
    )
    assert not set(tests) & {v.adversary for i in range(4) for v in splits.variations(run, i, parts.train[i])}
    registry.batch([kinds[1]])


def test_meta_world_trains_on_ml1s_first_tasks_and_tests_on_the_next(small_run: Run) -> None:
    control = dataclasses.replace(small_run.control, train_tasks=3, test_tasks=2, disturbance=0.02, horizon=40)
    run = dataclasses.replace(small_run, problem="metaworld-pick-place", control=control)
    parts = splits.split(run)
    assert (len(parts.train), len(parts.test)) == (3, 2)
    places = [task.vector("goal") for task in (*parts.train, *parts.test)]
    assert places == [task.vector("goal") for task in ml1_tasks(5, 0)]
    assert {(t["horizon"], t["disturbance"]) for t in parts.train + parts.test} == {(40, 0.02)}
    assert splits.spec(run) == registry.spec(parts.train[0]) and splits.disturbance(run) == 9
    registry.batch([splits.variations(run, 0, parts.train[0])[1]])
