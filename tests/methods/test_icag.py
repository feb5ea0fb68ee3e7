"""ICAG's variations, and DAgger rounds after D_pre."""

from __future__ import annotations

import dataclasses

import numpy as np

from icrl_dist.collect.adapt import LabelledRollouts
from icrl_dist.config.run import Run
from icrl_dist.config.sections import DAggerConfig
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry as problems
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.types import NULL
from tests.jobs import FixedWeights, InMemoryDataset, collect
from tests.methods.conftest import PoolsOf


def test_dpt_and_d0_of_icaa_have_no_disturbance_and_icag_has_k_adversaries(small_run: Run) -> None:
    adversaries = {}
    for name in ("dpt", "icag", "icaa"):
        run = dataclasses.replace(small_run, method=name)
        method = methods.of(run)
        adversaries[name] = [
            [job.variations[row].adversary for row, (of, _) in enumerate(job.rows()) if of == task]
            for job in method.ask(run, method.phases(run)[0])
            for task in range(job.task, job.task + job.tasks)
        ]
    assert adversaries["dpt"] == adversaries["icaa"] == [[NULL]] * len(adversaries["dpt"])
    assert len(adversaries["icag"]) == len(adversaries["dpt"]) == len(problems.of(small_run).split.train)
    for chosen in adversaries["icag"]:
        assert chosen[0] == NULL
        assert len(set(chosen)) == small_run.adversary.variations


def test_dagger_adds_own_histories_from_the_origin_with_optimal_labels(icag_run: Run, pools_of: PoolsOf) -> None:
    """In rounds after D_pre T^j acts, the optimal policy labels, and contexts are histories as deployed."""
    dagger = DAggerConfig(rounds=2, trials=3, steps=7, learning_rate=0.5, new_fraction=0.25)
    run = dataclasses.replace(icag_run, dagger=dagger)
    problem, method, data = problems.of(run), methods.of(run), InMemoryDataset()
    weights = FixedWeights(run)
    phases = method.phases(run)
    assert [(p.stage, p.policy_version, p.next_version) for p in phases] == [
        ("pretrain", -1, 0),
        ("adapt", 0, 1),
        ("adapt", 1, 2),
    ]
    assert [(p.steps, p.learning_rate) for p in phases[1:]] == [(7, 0.5)] * 2
    variations = [
        v
        for i, task in enumerate(problem.split.train)
        for v in problems.training_variations(run, i, problem.at_test_start(task))
    ]
    room = run.section("darkroom")
    for phase in phases:
        jobs = method.ask(run, phase)
        made = collect(run, phase, weights, method)
        data.trajectories += made
        pools = pools_of(method, run, phase, data)
        assert [len(pool.examples) for pool in pools] == [len(variations), phase.next_version * len(variations)][: len(pools)]
        assert len(pools) == 1 + (phase.stage == "adapt")
        if phase.stage == "pretrain":
            continue
        assert [v for job in jobs for v in job.variations] == variations, "other variations than those of D_pre"
        assert [pool.share for pool in pools] == [0.75, 0.25]
        assert [pool.episodes for pool in pools] == [run.optim.episodes, 3]
        assert {(t.policy_version, t.weights_digest) for t in made} == {(phase.round, f"digest {phase.round}")}
        for t in made:
            assert (t.observations[0] == 0).all()
            truth = soft_labels(Hypotheses.of([t.variation]), room.gamma, room.label_slack)[0]
            np.testing.assert_array_equal(t.labels, truth[cell_numbers(t.queries, 3)])
        first = pools[1].examples[0]
        trials = data.trials(("adapt", 0, 0, 0))
        assert first.history and len(trials) == 3
        np.testing.assert_array_equal(first.actions, np.stack([t.actions for t in trials]))
        np.testing.assert_array_equal(first.labels, np.concatenate([t.labels for t in trials]))
        assert not pools[0].examples[0].history
    assert len({tuple(t.actions) for t in data.trials(("adapt", 0, 0, 1)) + data.trials(("adapt", 1, 0, 1))}) == 6


def test_dagger_jobs_take_the_deployment_rules_in_turn(icag_run: Run) -> None:
    """From job to job and from round to round; a model without action windows has one rule."""
    without = dataclasses.replace(icag_run, dagger=DAggerConfig(rounds=3, trials=2))
    run = dataclasses.replace(
        without,
        model=dataclasses.replace(without.model, window=3),
        pretrain=dataclasses.replace(without.pretrain, windows=1),
        optim=dataclasses.replace(without.optim, windows=1),
    )

    def rules(run: Run, number: int) -> list[str]:
        method = methods.of(run)
        payloads = [job.payload for job in method.ask(run, method.phases(run)[number])]
        assert all(isinstance(payload, LabelledRollouts) for payload in payloads)
        return [payload.deploy for payload in payloads if isinstance(payload, LabelledRollouts)]

    assert set(rules(without, 1)) == {"paper"}
    rounds = [rules(run, number) for number in (1, 2, 3)]
    assert all(sorted(one) == ["committed", "paper", "paper"] for one in zip(*rounds, strict=True)) and len(rounds[0]) > 1
    assert rounds[0][:2] == ["paper", "committed"]
