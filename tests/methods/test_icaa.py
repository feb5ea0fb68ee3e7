"""ICAA against Algorithm 3, line by line."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run, validate
from icrl_dist.interfaces import VariationKey
from icrl_dist.methods import examples
from icrl_dist.methods import registry as methods
from icrl_dist.methods.examples import self_labelled
from icrl_dist.problems import registry as problems
from icrl_dist.results import training_rows
from icrl_dist.training import batches
from icrl_dist.training.batches import Examples
from icrl_dist.types import Trajectory
from tests.jobs import InMemoryDataset, do
from tests.methods.conftest import Collected, PoolsOf


def test_icaa_rolls_out_version_j_in_round_j_and_produces_j_plus_1(small_run: Run) -> None:
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, rounds=2))
    method = methods.of(run)
    phases = method.phases(run)
    assert [(p.stage, p.round, p.policy_version, p.next_version) for p in phases] == [
        ("pretrain", 0, -1, 0),
        ("adapt", 0, 0, 1),
        ("adapt", 1, 1, 2),
        ("adapt", 2, 2, 3),
    ]
    for phase in phases[1:]:
        for job in method.ask(run, phase):
            assert job.policy_version == phase.round
            assert job.trials == run.icaa.trials + 1
            assert all(v.task.vector("start") == (0, 0) for v in job.variations)


def test_dagger_rounds_are_refused_because_icaa_has_its_own(small_run: Run) -> None:
    run = dataclasses.replace(small_run, dagger=dataclasses.replace(small_run.dagger, rounds=1))
    with pytest.raises(ConfigError, match=r"dagger.rounds = 1: icaa has no such rounds: use 0$"):
        validate(run, "test")


def test_every_round_has_new_adversaries(small_run: Run) -> None:
    method, task = methods.of(small_run), problems.of(small_run).split.train[0]
    rounds = [method.training_variations(small_run, 0, task, round) for round in (0, 1)]
    assert [group[0].adversary.kind for group in rounds] == ["null", "null"]
    assert not {v.adversary for v in rounds[0][1:]} & {v.adversary for v in rounds[1][1:]}


def test_jobs_deliver_exactly_their_identities_and_one_version_acts_in_all_trials(small_run: Run, collected: Collected) -> None:
    trajectories, weights = collected
    method = methods.of(small_run)
    expected = [i for phase in method.phases(small_run) for job in method.ask(small_run, phase) for i in job.identities()]
    assert sorted(t.identity for t in trajectories) == sorted(expected)
    assert {(t.identity.round, t.policy_version, t.weights_digest) for t in trajectories if t.identity.stage == "adapt"} == {
        (0, 0, "digest 0"),
        (1, 1, "digest 1"),
    }
    count = len(method.ask(small_run, method.phases(small_run)[1]))
    assert weights.requested == [0] * count + [1] * count


def test_no_test_goal_is_ever_trained_on(small_run: Run, collected: Collected) -> None:
    held_out = {t.vector("goal") for t in problems.of(small_run).split.test}
    assert held_out
    assert not held_out & {t.variation.task.vector("goal") for t in collected.trajectories}


def test_the_same_job_gives_the_same_trajectories_on_every_worker(small_run: Run, collected: Collected) -> None:
    method = methods.of(small_run)
    for phase in method.phases(small_run)[:2]:
        job = method.ask(small_run, phase)[1]
        pairs = zip(do(small_run, job, collected.weights, "a"), do(small_run, job, collected.weights, "b"), strict=True)
        for one, two in pairs:
            assert one.identity == two.identity
            assert all((a == b).all() for a, b in zip(one.arrays().values(), two.arrays().values(), strict=True))


def test_labels_come_from_strictly_later_trials_than_contexts(small_run: Run, collected: Collected) -> None:
    data = InMemoryDataset(collected.trajectories)
    for trials in map(data.trials, data.variations("adapt", 0)):
        made = self_labelled(small_run, trials)
        assert made is not None
        cut = small_run.icaa.context_trials + 1
        np.testing.assert_array_equal(made.actions, np.stack([t.actions for t in trials[:cut]]))
        np.testing.assert_array_equal(made.queries, np.concatenate([t.observations[:-1] for t in trials[cut:]]))
        np.testing.assert_array_equal(made.labels.argmax(axis=1), np.concatenate([t.actions for t in trials[cut:]]))


def with_returns(trials: Sequence[Trajectory], returns: Sequence[float]) -> list[Trajectory]:
    """The trials with other rewards, the same at every step."""
    horizon = len(trials[0].rewards)
    pairs = zip(trials, returns, strict=True)
    return [dataclasses.replace(t, rewards=np.full(horizon, value / horizon, np.float32)) for t, value in pairs]


def test_top_return_takes_the_better_half_of_the_later_trials(small_run: Run, collected: Collected) -> None:
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, label_trials="top_return"))
    trials = InMemoryDataset(collected.trajectories).trials(("adapt", 0, 0, 0))
    better = with_returns(trials, [8.0 * (n == 3) for n in range(len(trials))])
    made = self_labelled(run, better)
    assert made is not None and len(made.queries) == 8 * 2
    np.testing.assert_array_equal(made.queries[:8], better[3].observations[:-1])


def test_improved_takes_the_later_trials_that_return_more_than_the_contexts(small_run: Run, collected: Collected) -> None:
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, label_trials="improved"))
    trials = InMemoryDataset(collected.trajectories).trials(("adapt", 0, 0, 0))
    made = self_labelled(run, with_returns(trials, [1.0, 3.0, 2.0, 8.0, 1.0]))
    assert made is not None
    np.testing.assert_array_equal(made.queries, trials[3].observations[:-1])
    assert self_labelled(run, with_returns(trials, [3.0, 3.0, 2.0, 1.0, 3.0])) is None


def test_each_round_learns_from_d0_and_all_rounds_so_far(small_run: Run, collected: Collected, pools_of: PoolsOf) -> None:
    method, data = methods.of(small_run), InMemoryDataset(collected.trajectories)
    first, second, third = (pools_of(method, small_run, phase, data) for phase in method.phases(small_run))
    tasks = len(problems.of(small_run).split.train)
    variations = tasks * small_run.adversary.variations
    assert [len(pool.examples) for pool in first] == [tasks]
    assert [len(pool.examples) for pool in second] == [len(first[0].examples), variations]
    assert [len(pool.examples) for pool in third] == [len(first[0].examples), 2 * variations]
    assert [pool.share for pool in third] == [1 - small_run.icaa.new_fraction, small_run.icaa.new_fraction]


def test_contexts_are_1_to_all_of_trials_0_to_n_in_their_order(small_run: Run, collected: Collected, pools_of: PoolsOf) -> None:
    """Algorithm 3, line 13, takes all N_ + 1 of them, also where ``optim.episodes``, for D^0, is fewer."""
    icaa, optim = dataclasses.replace(small_run.icaa, context_trials=2), dataclasses.replace(small_run.optim, episodes=1)
    run = dataclasses.replace(small_run, icaa=icaa, optim=optim)
    method, data = methods.of(run), InMemoryDataset(collected.trajectories)
    phase = method.phases(run)[1]
    undisturbed, own = pools_of(method, run, phase, data)
    assert undisturbed.episodes == 1
    trials = [data.trials(key) for key in data.variations("adapt", 0)]
    own_actions = [np.concatenate([t.actions for t in of]) for of in trials]
    draw, lengths = method.data(run, phase, data), Counter[int]()
    for seed in range(60):
        batch = draw(np.random.default_rng(seed))
        if any(len(batch.actions[0]) <= len(a) and (a[: len(batch.actions[0])] == batch.actions[0]).all() for a in own_actions):
            for row in batch.actions:
                assert any((a[: len(row)] == row).all() for a in own_actions), "trials 0 to n, in order"
            lengths[batch.actions.shape[1] // 8] += 1
    assert sorted(lengths) == [1, 2, 3]
    assert own.episodes == 3


def test_contexts_of_one_trial_are_any_of_trials_0_to_n(small_run: Run, collected: Collected, pools_of: PoolsOf) -> None:
    """Algorithm 3, lines 13 and 15, word by word, whatever ``optim.episodes`` is for D^0."""
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, context="trial"))
    assert run.optim.episodes > 1
    method, data = methods.of(run), InMemoryDataset(collected.trajectories)
    phase = method.phases(run)[1]
    undisturbed, own = pools_of(method, run, phase, data)
    drawn = [batches.draw(np.random.default_rng(seed), [own], 8, 4) for seed in range(20)]
    assert undisturbed.episodes == run.optim.episodes and {batch.actions.shape[1] for batch in drawn} == {8}
    firsts = [data.trials(key)[: run.icaa.context_trials + 1] for key in data.variations("adapt", 0)]
    numbers = {n for trials in firsts for n, t in enumerate(trials) for b in drawn for a in b.actions if (a == t.actions).all()}
    assert numbers == {0, 1}


def test_each_variation_is_labelled_once_a_run(small_run: Run, collected: Collected, monkeypatch: pytest.MonkeyPatch) -> None:
    """``label_quality`` and ``data`` of all rounds share the labels, which each round would otherwise compute anew."""
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, label_trials="improved"))
    labelled: Counter[VariationKey] = Counter()

    def count(run: Run, trials: Sequence[Trajectory]) -> Examples | None:
        labelled[trials[0].identity[:4]] += 1
        return self_labelled(run, trials)

    monkeypatch.setattr(examples, "self_labelled", count)
    method, data = methods.of(run), InMemoryDataset(collected.trajectories)
    pretrain, *rounds = method.phases(run)
    assert not list(method.label_quality(run, pretrain, data))
    method.data(run, pretrain, data)(np.random.default_rng(0))
    assert not labelled, "D^0 has labels of the exact solver"
    assert len(rounds) == run.icaa.rounds + 1 > 1
    shares = []
    for phase in rounds:
        shares.append(np.mean([one.agreement is not None for one in method.label_quality(run, phase, data)]))
        draw = method.data(run, phase, data)
        for seed in range(20):
            draw(np.random.default_rng(seed))
        so_far = [key for j in range(phase.round + 1) for key in data.variations("adapt", j)]
        assert labelled == dict.fromkeys(so_far, 1)
    assert any(0 < share < 1 for share in shares), "a variation without labels must not be computed anew either"


def test_label_quality_compares_labels_with_the_exact_answer(small_run: Run, collected: Collected, tmp_path: Path) -> None:
    data, method = InMemoryDataset(collected.trajectories), methods.of(small_run)
    phase, exact = method.phases(small_run)[1], problems.of(small_run).exact
    assert exact is not None
    cut = small_run.icaa.context_trials + 1
    agreement, early, late, optimum = [], [], [], []
    for trials in map(data.trials, data.variations("adapt", 0)):
        own = self_labelled(small_run, trials)
        assert own is not None
        agreement.append(exact.optimal(trials[0].variation, own.queries, own.labels).mean())
        early.append(np.mean([t.episode_return for t in trials[:cut]]))
        late.append(np.mean([t.episode_return for t in trials[cut:]]))
        optimum.append(exact.optimum([trials[0].variation])[0])
    expected = {"agreement": agreement, "context_return": early, "label_return": late, "optimum": optimum}
    found = training_rows.rate_labels(small_run, tmp_path, phase, method.label_quality(small_run, phase, data), pytest.fail)
    assert found is not None and dataclasses.asdict(found) == pytest.approx(
        {name: np.mean(values) for name, values in expected.items()} | {"labelling": 1.0}
    )
