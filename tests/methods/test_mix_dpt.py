"""Mix-DPT's schedule: steps of its phases, episodes of D^0 and of its histories, shares of both in drawn batches."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run, load_run, override, validate
from icrl_dist.methods import registry as methods
from icrl_dist.methods.mix_dpt import steps_of_phases
from icrl_dist.problems import registry as problems
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.training import batches
from icrl_dist.training.batches import Examples, Pool
from icrl_dist.types import NULL
from tests.jobs import FixedWeights, InMemoryDataset, collect
from tests.methods.conftest import PoolsOf


@pytest.fixture
def run(small_run: Run) -> Run:
    """Two rounds of two episodes in each of 7 tasks; D_pre of DPT would have 6 episodes a task."""
    return override(dataclasses.replace(small_run, method="mix_dpt"), ["mix_dpt.rounds=2", "mix_dpt.trials=2"], "x")


@pytest.mark.parametrize("steps", [14, 15, 59, 2800])
@pytest.mark.parametrize("rounds", [1, 2, 3, 7])
def test_the_early_phase_has_two_fifths_of_the_steps_and_the_rounds_divide_the_others(
    run: Run, steps: int, rounds: int
) -> None:
    """A slow loop deals out the steps one by one: DPT's number of them, first the early phase, then a round in turn."""
    run = dataclasses.replace(run, pretrain=dataclasses.replace(run.pretrain, contexts=56, steps=steps))
    run = override(run, [f"mix_dpt.rounds={rounds}", "mix_dpt.trials=1", "mix_dpt.learning_rate=0.5"], "x")
    dealt: Counter[int] = Counter()
    for step in range(steps):
        early = step + 0.5 < 0.4 * steps
        dealt[-1 if early else (step - dealt[-1]) % rounds] += 1
    phases = methods.of(run).phases(run)
    assert [p.steps for p in phases] == steps_of_phases(run) == [dealt[j] for j in range(-1, rounds)]
    assert sum(p.steps for p in phases) == steps
    assert [(p.stage, p.policy_version, p.learning_rate) for p in phases] == [
        ("pretrain", -1, run.optim.learning_rate),
        *(("adapt", j, 0.5) for j in range(rounds)),
    ]


def test_d0_and_the_histories_are_as_many_episodes_as_dpts_all_undisturbed_with_optimal_labels(run: Run) -> None:
    weights, room, method = FixedWeights(run), run.section("darkroom"), methods.of(run)
    found = {phase: collect(run, phase, weights, method) for phase in method.phases(run)}
    tasks = problems.of(run).train_count
    assert [len(made) for made in found.values()] == [2 * tasks, 2 * tasks, 2 * tasks]
    dpt = dataclasses.replace(run, method="dpt")
    jobs = methods.of(dpt).ask(dpt, methods.of(dpt).phases(dpt)[0])
    assert sum(map(len, found.values())) == sum(job.trials * len(job.variations) for job in jobs)
    for phase, made in found.items():
        assert {t.policy_version for t in made} == {phase.policy_version}
        for t in made:
            assert t.variation.adversary == NULL and t.origin == "optimal"
            truth = soft_labels(Hypotheses.of([t.variation]), room.gamma, room.label_slack)[0]
            np.testing.assert_array_equal(t.labels, truth[cell_numbers(t.queries, 3)])


class Noting:
    """Examples that note the name of their pool whenever one of them is taken."""

    def __init__(self, name: str, examples: batches.ExamplesSequence, taken: list[str]) -> None:
        self._name, self._examples, self._taken = name, examples, taken

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, index: int) -> Examples:
        self._taken.append(self._name)
        return self._examples[index]


def slow_pools(seeds: range, kappa: float) -> Iterator[str]:
    """The pool of each batch, by one uniform number a batch."""
    for seed in seeds:
        u = np.random.default_rng(seed).random()
        yield "D^0" if u < kappa else "histories"


@pytest.mark.parametrize("kappa", [1 / 3, 0.75])
def test_a_batch_comes_from_d0_with_probability_kappa_else_from_the_histories_so_far(
    run: Run, pools_of: PoolsOf, kappa: float
) -> None:
    run = override(run, [f"mix_dpt.kappa={kappa}"], "x")
    weights, data, method = FixedWeights(run), InMemoryDataset(), methods.of(run)
    tasks, seeds = problems.of(run).train_count, range(400)
    for phase in method.phases(run):
        data.trajectories += collect(run, phase, weights, method)
        pools = pools_of(method, run, phase, data)
        assert [len(pool.examples) for pool in pools] == [tasks, tasks * phase.next_version][: len(pools)]
        taken: list[str] = []
        noted = [
            Pool(p.share, Noting(name, p.examples, taken), p.episodes)
            for name, p in zip(("D^0", "histories"), pools, strict=False)
        ]
        for seed in seeds:
            drawn = batches.draw(np.random.default_rng(seed), noted, batch=3, queries=2)
            assert len(drawn.queries) == 3 and len(set(taken[-3:])) == 1, "a batch comes from one pool"
        expected = list(slow_pools(seeds, kappa)) if phase.stage == "adapt" else ["D^0"] * len(seeds)
        assert taken[::3] == expected
        assert phase.stage == "pretrain" or abs(expected.count("D^0") / len(seeds) - kappa) < 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["dagger.rounds=1"], r"dagger.rounds = 1: mix_dpt has rounds of its own \(mix_dpt.rounds\): use dagger.rounds = 0"),
        (
            ["mix_dpt.trials=3"],
            r"pretrain.contexts = 42: use at least 49: 2 rounds of 3 episodes in 7 tasks leave none for D\^0",
        ),
        (["pretrain.steps=2"], "pretrain.steps = 2: too few for the early phase and every round: raise it, or lower"),
        (["mix_dpt.early=1.0"], r"mix_dpt.early = 1.0: must lie between 0 and 1, so that no phase is without steps"),
        (["mix_dpt.early=0.0"], r"mix_dpt.early = 0.0: must lie between 0 and 1, so that no phase is without steps"),
        (["mix_dpt.rounds=0"], "mix_dpt.rounds = 0: must be from 1 to 9000"),
    ],
)
def test_what_it_cannot_do_is_refused_with_the_remedy(run: Run, settings: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        override(run, settings, "x")
    validate(override(run, ["mix_dpt.trials=3", "pretrain.contexts=49", "pretrain.steps=3"], "x"), "x")


def test_a_problem_that_cannot_label_histories_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"method = 'mix_dpt': metaworld-pick-place cannot label new histories.*use dpt or icag"
    ):
        load_run("metaworld-laptop", "method=mix_dpt")
