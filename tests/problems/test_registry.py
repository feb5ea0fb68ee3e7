"""The tasks and adversaries of training and of tests."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import Run, make_run
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.continuous.problem import ContinuousProblem
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld.environment import ml1_tasks
from icrl_dist.types import NULL, Split, Variation
from tests.jobs import in_problem


def with_room(run: Run, **values: object) -> Run:
    return in_problem(run, "darkroom", darkroom=dataclasses.replace(run.section("darkroom"), **values))


def split(run: Run) -> Split:
    return registry.of(run).split


@pytest.mark.parametrize(("size", "train"), [(10, 80), (3, 7), (5, 20)])
def test_split_is_disjoint_and_complete(small_run: Run, size: int, train: int) -> None:
    problem = registry.of(with_room(small_run, size=size))
    parts = problem.split
    assert (len(parts.train), len(parts.test)) == (train, size * size - train)
    assert problem.train_count == train
    goals = [t["goal"] for t in parts.train + parts.test]
    assert sorted(goals) == [(x, y) for x in range(size) for y in range(size)]
    assert {t["horizon"] for t in parts.train + parts.test} == {8}
    assert all("start" not in dict(t.params) for t in parts.train), "a training task has a fixed start"


def test_split_is_computed_once_and_follows_its_own_seed_alone(small_run: Run) -> None:
    big = with_room(small_run, size=10)
    assert split(big) is split(dataclasses.replace(big, seed=7)), "the run's seed must not change the split"
    held_out = [frozenset(split(with_room(big, split_seed=seed)).test) for seed in range(5)]
    assert len(set(held_out)) == 5
    # Shuffled, not the last rows of the room.
    assert {t.vector("goal")[0] for t in held_out[0]} != {8, 9}


def test_train_fraction_decides_the_cut(small_run: Run) -> None:
    half = split(with_room(small_run, size=4, train_fraction=0.5))
    assert (len(half.train), len(half.test)) == (8, 8)


def test_test_episodes_start_in_the_origin_and_nothing_else_changes(small_run: Run) -> None:
    task = split(small_run).test[0]
    at_start = registry.of(small_run).at_test_start(task)
    assert at_start["start"] == (0, 0)
    assert {k: v for k, v in at_start.params if k != "start"} == dict(task.params)
    assert {tuple(registry.make(Variation(at_start)).reset(seed=seed)[0]) for seed in range(8)} == {(0, 0)}


def test_variations_are_the_tasks_own_and_repeat(small_run: Run) -> None:
    train = split(small_run).train
    every = [registry.training_variations(small_run, i, t) for i, t in enumerate(train)]
    assert every == [registry.training_variations(small_run, i, t) for i, t in enumerate(train)]
    assert all([v.task for v in vs] == [t] * small_run.adversary.variations for vs, t in zip(every, train, strict=True))
    assert all(vs[0].adversary == NULL for vs in every)
    drawn = [v.adversary for vs in every for v in vs[1:]]
    assert len(set(drawn)) == len(drawn), "two tasks share an adversary"
    other = registry.training_variations(dataclasses.replace(small_run, seed=1), 0, train[0])
    assert not {v.adversary for v in other[1:]} & set(drawn)
    assert max(a.number("p") for a in drawn) <= small_run.adversary.p_max


@pytest.mark.parametrize("null", [True, False])
def test_k_counts_disturbances_and_a_switch_adds_the_null_adversary(small_run: Run, null: bool) -> None:
    task = split(small_run).train[0]
    for count in (1, 2, 8):
        run = dataclasses.replace(small_run, adversary=AdversaryConfig(count=count, null=null))
        found = [v.adversary for v in registry.training_variations(run, 0, task)]
        assert len(set(found)) == len(found) == run.adversary.variations == count + null
        assert [one == NULL for one in found] == [True] * null + [False] * count
        assert tuple(found[null:]) == registry.of(run).training_adversaries(
            generator(run.seed, RandomKey.TRAINING_ADVERSARIES, 0, 0), run.adversary
        )


@pytest.mark.parametrize("prior", ["unseen", "uniform"])
def test_test_adversaries_differ_from_every_training_adversary(small_run: Run, prior: str) -> None:
    train = split(small_run).train
    seen = {v.adversary for i, t in enumerate(train) for v in registry.training_variations(small_run, i, t)}
    alphas = {a.vector("alpha") for a in seen - {NULL}}
    for index in range(20):
        for p in (0.1, 0.2):
            one = registry.test_adversary(small_run, index, p, prior)
            assert one not in seen
            assert one.number("p") == p
            assert prior == "uniform" or one.vector("alpha") not in alphas


def test_test_adversaries_repeat_and_keep_their_distribution_as_p_grows(small_run: Run) -> None:
    weak, strong = (registry.test_adversary(small_run, 3, p, "unseen") for p in (0.1, 0.6))
    assert weak == registry.test_adversary(small_run, 3, 0.1, "unseen")
    assert weak.vector("alpha") == strong.vector("alpha")
    assert len({registry.test_adversary(small_run, i, 0.1, "unseen") for i in range(20)}) == 20
    assert registry.test_adversary(small_run, 3, 0.1, "uniform").kind == "uniform"
    assert registry.test_adversary(small_run, 3, 0.0, "unseen") == NULL


def test_each_draw_of_a_task_is_another_adversary_and_draw_0_is_that_of_older_versions(small_run: Run) -> None:
    drawn = [registry.test_adversary(small_run, i, 0.2, "unseen", draw) for i in range(5) for draw in range(8)]
    assert len(set(drawn)) == 40 and {a.number("p") for a in drawn} == {0.2}
    before = registry.of(small_run).test_adversary(
        np.random.default_rng(np.random.SeedSequence(0, spawn_key=(103, 3))), 0.2, "unseen"
    )
    assert registry.test_adversary(small_run, 3, 0.2, "unseen") == before == drawn[24]
    assert len({registry.test_adversary(small_run, 3, 0.2, "uniform", draw) for draw in range(8)}) == 1


def continuous(run: Run, problem: str, control: ControlConfig) -> tuple[Run, ContinuousProblem]:
    made = make_run(problem, control=control, adversary=run.adversary)
    owner = registry.of(made)
    assert isinstance(owner, ContinuousProblem)
    return made, owner


def test_a_continuous_run_trains_on_the_center_and_tests_elsewhere(small_run: Run) -> None:
    control = ControlConfig(train_tasks=4, test_tasks=6, horizon=50, forces="qarl", strength=2.0)
    run, problem = continuous(small_run, "dmc-hopper-hop", control)
    parts = problem.split
    assert (len(parts.train), len(parts.test)) == (4, 6) and not set(parts.train) & set(parts.test)
    masses = {task.number("torso_mass") for task in domains.grid(run.problem, 2)}
    assert {task.number("torso_mass") for task in parts.train} == masses
    assert {(t["horizon"], t["forces"]) for t in parts.train + parts.test} == {(50, "qarl")}
    assert parts is split(dataclasses.replace(run, seed=7)), "the run's seed must not change the split"
    other = continuous(small_run, run.problem, dataclasses.replace(control, split_seed=1))[1].split
    assert other.train == parts.train and set(other.test) != set(parts.test)
    assert problem.spec == registry.spec(parts.test[0]) and problem.disturbances == 2
    variations = registry.training_variations(run, 1, parts.train[1])
    assert variations[0].adversary == NULL and len({v.adversary for v in variations}) == run.adversary.variations
    assert {v.adversary["strength"] for v in variations[1:]} == {2.0}
    assert variations != registry.training_variations(run, 1, parts.train[1], 1)
    assert variations == registry.training_variations(run, 1, parts.train[1])
    tests = [registry.test_adversary(run, i, 0.5, "unseen") for i in range(6)]
    assert len(set(tests)) == 6 and {a["strength"] for a in tests} == {1.0}
    assert registry.test_adversary(run, 0, 0, "unseen") == NULL
    trained = {v.adversary for i in range(4) for v in registry.training_variations(run, i, parts.train[i])}
    assert not set(tests) & trained
    registry.batch([variations[1]])


def test_meta_world_trains_on_ml1s_first_tasks_and_tests_on_the_next(small_run: Run) -> None:
    control = ControlConfig(train_tasks=3, test_tasks=2, disturbance=0.02, horizon=40)
    run, problem = continuous(small_run, "metaworld-pick-place", control)
    parts = problem.split
    assert (len(parts.train), len(parts.test)) == (3, 2)
    places = [task.vector("goal") for task in (*parts.train, *parts.test)]
    assert places == [task.vector("goal") for task in ml1_tasks(5, 0)]
    assert {(t["horizon"], t["disturbance"]) for t in parts.train + parts.test} == {(40, 0.02)}
    assert problem.spec == registry.spec(parts.train[0]) and problem.disturbances == 9
    registry.batch([registry.training_variations(run, 0, parts.train[0])[1]])


def test_each_problem_is_one_object_for_equal_sections(small_run: Run) -> None:
    assert registry.of(small_run) is registry.of(dataclasses.replace(small_run, method="dpt", seed=3))
    assert registry.of(small_run) is not registry.of(with_room(small_run, size=4))
    assert registry.problem("darkroom") is registry.problem("darkroom")
    assert set(registry.names()) == {"darkroom", "metaworld-pick-place", *domains.PROBLEMS}
