"""Winds and permuted controls: the environment against a slow one, their priors, and exact answers against rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from icrl_dist.collect.behavior import BehaviorContexts, behavior_contexts
from icrl_dist.config.run import Run, override
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom import solver
from icrl_dist.problems.darkroom.adversaries import SYMMETRIES, Disturbance, adversary_set, grid, sample
from icrl_dist.problems.darkroom.exact_agents import OptimalAgent
from icrl_dist.problems.darkroom.room import ACTIONS, MOVES, DarkRoom
from icrl_dist.problems.darkroom.solver import Hypotheses
from icrl_dist.rollout.episode import episode
from icrl_dist.types import NULL, Adversary, Job, Task, Variation
from tests.problems.darkroom.test_room import rngs, slow_step

Room = Callable[[int, int], tuple[Task, ...]]
WIND = Adversary.of("wind", p=0.4, direction=1)
TURN = Adversary.of("permuted", p=0.4, permutation=SYMMETRIES[1])


@pytest.mark.parametrize("p", [0.0, 0.4, 1.0])
@pytest.mark.parametrize(
    "kind", [*(WIND.replace(direction=d) for d in range(4)), *(TURN.replace(permutation=s) for s in SYMMETRIES)]
)
def test_every_step_equals_the_slow_loop(room: Room, kind: Adversary, p: float) -> None:
    """The adversary's logged action tells where it acted and what it did; walls stop both moves of a wind."""
    tasks, adversary = room(3, 40), kind.replace(p=p)
    env = DarkRoom([Variation(t, adversary) for t in tasks])
    cells, rng, acted = env.reset(rngs(range(9))), np.random.default_rng(5), 0
    for _ in range(40):
        actions = rng.integers(0, ACTIONS, size=9)
        step = env.step(actions)
        for row, task in enumerate(tasks):
            x, y, logged = int(cells[row, 0]), int(cells[row, 1]), int(step.adversary[row])
            if kind.kind == "wind":
                expected = slow_step((x, y), int(actions[row]), 3)
                expected = expected if logged < 0 else slow_step(expected, logged, 3)
                assert logged in (-1, kind["direction"])
            else:
                expected = slow_step((x, y), int(actions[row]) if logged < 0 else logged, 3)
                assert logged in (-1, int(kind.vector("permutation")[actions[row]]))
            assert tuple(step.observation[row]) == expected
            assert step.reward[row] == (1.0 if expected == task["goal"] else 0.0)
            acted += logged >= 0
        cells = step.observation
    assert abs(acted / 360 - p) < 4 * np.sqrt(p * (1 - p) / 360) + 1e-9


def test_a_batch_of_all_families_gives_the_bytes_of_separate_ones() -> None:
    adversaries = (NULL, Adversary.of("uniform", p=0.5), WIND, TURN, Adversary.of("dirichlet", p=0.7, alpha=(1.0,) * 5))
    rows = [Variation(darkroom.task((2, 1), 4, 30), a) for a in adversaries]
    actions = np.random.default_rng(0).integers(0, ACTIONS, size=(30, 5))
    together = DarkRoom(rows)
    together.reset(rngs(range(5)))
    steps = [together.step(a) for a in actions]
    for row, variation in enumerate(rows):
        alone = DarkRoom([variation])
        alone.reset(rngs([row]))
        for action, step in zip(actions, steps, strict=True):
            one = alone.step(action[row : row + 1])
            assert (one.observation[0] == step.observation[row]).all() and one.adversary[0] == step.adversary[row]


def test_the_symmetries_are_those_of_the_square() -> None:
    """Every orthogonal matrix of whole numbers but the identity, applied to the moves."""
    found = set()
    for flipped in (False, True):
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            turned = (MOVES[:, ::-1] if flipped else MOVES) * signs
            found.add(tuple(MOVES.tolist().index(move) for move in turned.tolist()))
    assert set(SYMMETRIES) == found - {(0, 1, 2, 3, 4)} and len(SYMMETRIES) == 7


@pytest.mark.parametrize("kind", ["wind", "permuted"])
def test_priors_are_uniform(kind: Disturbance) -> None:
    made = adversary_set(np.random.default_rng(0), 2800, ACTIONS, 0.6, kind)
    assert all(a.kind == kind for a in made)
    p = np.array([a.number("p") for a in made])
    assert p.min() >= 0 and 0.59 < p.max() <= 0.6 and abs(p.mean() - 0.3) < 4 * 0.6 / np.sqrt(12 * 2800)
    others = [a.replace(p=0.0) for a in made]
    counts = np.array([others.count(a) for a in set(others)])
    assert len(counts) == (4 if kind == "wind" else 7)
    assert (abs(counts - 2800 / len(counts)) < 4 * np.sqrt(2800 / len(counts))).all()
    strong = [a.number("p") for a in adversary_set(np.random.default_rng(0), 400, ACTIONS, 0.6, kind, 0.4)]
    assert 0.4 <= min(strong) < 0.41 and 0.59 < max(strong) <= 0.6
    assert {a.number("p") for a in grid(kind, ACTIONS, 1.0, 2, 1.0)} == {1.0}
    levels = grid(kind, ACTIONS, 0.6, 3)
    assert sorted({a.number("p") for a in levels}) == pytest.approx([0.1, 0.3, 0.5])
    assert {a.replace(p=0.0) for a in levels} == set(others) and len(set(levels)) == 3 * len(counts)


@pytest.mark.parametrize("kind", ["wind", "permuted", "override"])
def test_without_strength_every_family_equals_no_disturbance(room: Room, kind: Disturbance) -> None:
    adversary = sample(np.random.default_rng(1), kind, ACTIONS, 1.0).replace(p=0.0)
    tasks = room(4, 9)
    some, none = (Hypotheses.of([Variation(t, a) for t in tasks]) for a in (adversary, NULL))
    np.testing.assert_allclose(solver.q_values(some, 0.99), solver.q_values(none, 0.99), rtol=1e-12)
    np.testing.assert_array_equal(solver.soft_labels(some, 0.99, 0.1), solver.soft_labels(none, 0.99, 0.1))
    np.testing.assert_allclose(solver.optimal_values(some.as_moves()), solver.optimal_values(none), rtol=1e-12)
    ran = [
        episode(DarkRoom([Variation(tasks[5], a)]), OptimalAgent(np.full((1, 16, 5), 0.2, np.float32), 4), rngs([3]))
        for a in (adversary, NULL)
    ]
    np.testing.assert_array_equal(ran[0].observations, ran[1].observations)
    assert (ran[0].adversary == -1).all()


@pytest.mark.parametrize("adversary", [WIND.replace(p=0.7), TURN.replace(p=0.8), TURN.replace(p=1.0)])
def test_the_optimal_agent_earns_the_optimal_return(adversary: Adversary) -> None:
    """Solver against simulation, for goals at a wall and inside."""
    rows, size, horizon = 1500, 4, 15
    for goal in ((0, 3), (2, 1)):
        variation = Variation(darkroom.task(goal, size, horizon, (0, 0)), adversary)
        h = Hypotheses.of([variation])
        policy = solver.soft_labels(h, 1.0, 0.0)
        agent = OptimalAgent(np.repeat(policy, rows, axis=0), size)
        earned = episode(DarkRoom([variation] * rows), agent, rngs(range(rows))).returns
        promised, error = solver.optimal_returns(h)[0], earned.std(ddof=1) / np.sqrt(rows)
        # The policy is that of the episode's first step; near the end another may be slightly better.
        assert abs(earned.mean() - promised) <= 4 * error + 0.02 * promised, (goal, earned.mean(), promised)
        expected = solver.expected_returns(policy, [variation])[0]
        assert abs(earned.mean() - expected) <= 4 * error + 1e-9 and expected <= promised + 1e-9


@pytest.mark.parametrize("kind", ["override", "wind", "permuted"])
def test_only_overrides_have_an_exact_worst_case(small_run: Run, kind: str) -> None:
    problem = registry.of(override(small_run, [f"darkroom.disturbance={kind}"], "test"))
    assert (problem.certify is not None) == (kind == "override")


@pytest.mark.parametrize("kind", ["wind", "permuted"])
def test_a_job_labels_contexts_and_windows_of_the_disturbed_optimum(small_run: Run, kind: str) -> None:
    """Contexts are disturbed, and labels, also those of windows, are optimal for goal and adversary."""
    settings = [
        f"darkroom.disturbance={kind}",
        "adversary.p_max=1.0",
        "adversary.count=4",
        "model.window=3",
        "optim.windows=1",
        "pretrain.windows=2",
    ]
    run = override(dataclasses.replace(small_run, method="icag"), settings, "test")
    problem = registry.of(run)
    group = registry.training_variations(run, 0, problem.split.train[0])
    disturbed = [v for v in group if v.adversary != NULL]
    assert {v.adversary.kind for v in disturbed} == {kind}
    labelling = problem.labelling(run)
    payload = problem.contexts(run).payload
    assert isinstance(payload, BehaviorContexts)
    job = Job("behavior_context", "pretrain", 0, 0, tuple(group), 3, -1, run.seed, payload)
    made = list(behavior_contexts(job, problem, "test", lambda *_: None))
    acted = 0
    for one in made:
        best = solver.soft_labels(Hypotheses.of([one.variation]), labelling.gamma, labelling.slack)[0]
        np.testing.assert_array_equal(one.labels, best[solver.cell_numbers(one.queries, 3)])
        acted += int((one.adversary >= 0).sum())
        assert (one.variation.adversary != NULL) or (one.adversary == -1).all()
    assert acted > 0 and len(made) == 3 * len(group) and len(made[0].prev_actions) == 6


def test_test_adversaries_have_the_given_strength_and_every_direction(small_run: Run) -> None:
    for kind, count in (("wind", 4), ("permuted", 7)):
        problem = registry.of(override(small_run, [f"darkroom.disturbance={kind}"], "test"))
        drawn = [
            problem.test_adversary(np.random.default_rng(seed), 0.6, prior)
            for seed in range(60)
            for prior in ("uniform", "unseen")
        ]
        assert {(a.kind, a.number("p")) for a in drawn} == {(kind, 0.6)} and len(set(drawn)) == count
        assert drawn[::2] == drawn[1::2], "both priors are the same draw"
