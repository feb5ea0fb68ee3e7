"""The recipes against Algorithms 2 and 3, line by line."""

import dataclasses

import numpy as np
import pytest
from icrl_dist.methods.recipes import METHODS, self_labelled

from icrl_dist.collect import jobs
from icrl_dist.config.sections import DAggerConfig
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import splits
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.types import NULL, Identity


class Kept:
    """A dataset in memory, given in any order."""

    def __init__(self, trajectories):
        self.trajectories = list(trajectories)

    def variations(self, stage, round_):
        return sorted({t.identity[:4] for t in self.trajectories if t.identity[:2] == (stage, round_)})

    def trials(self, key):
        return sorted((t for t in self.trajectories if t.identity[:4] == key), key=lambda t: t.identity.trial)


class Fixed:
    """One untrained model for every version."""

    def __init__(self, spec, config):
        self.model = PretrainedTransformer(spec, config).eval()
        self.asked = []

    def at(self, version):
        self.asked.append(version)
        return self.model, f"digest {version}"


@pytest.fixture
def collected(small_run):
    method = METHODS["icaa"]
    from icrl_dist.problems.registry import spec

    policies = Fixed(spec(splits.split(small_run).train[0]), small_run.model)
    trajectories = []
    for phase in method.phases(small_run):
        for job in method.ask(small_run, phase):
            trajectories += jobs.do(job, policies, "w")
    return trajectories, policies


def test_every_method_shares_out_the_same_number_of_contexts(small_run):
    for name in ("dpt", "icag", "icaa"):
        phase = METHODS[name].phases(small_run)[0]
        asked = METHODS[name].ask(small_run, phase)
        assert sum(job.tasks for job in asked) == len(splits.split(small_run).train)
        assert all(job.tasks <= small_run.stream.job_tasks for job in asked)
        assert sum(len(job.variations) * job.trials for job in asked) == small_run.pretrain.contexts
        assert all(job.policy_version == -1 for job in asked)


def test_dpt_and_d0_of_icaa_have_no_disturbance_and_icag_has_k_adversaries(small_run):
    adversaries = {}
    for name in ("dpt", "icag", "icaa"):
        phase = METHODS[name].phases(small_run)[0]
        adversaries[name] = [
            [job.variations[row].adversary for row, (of, _) in enumerate(job.rows()) if of == task]
            for job in METHODS[name].ask(small_run, phase)
            for task in range(job.task, job.task + job.tasks)
        ]
    assert adversaries["dpt"] == adversaries["icaa"] == [[NULL]] * len(adversaries["dpt"])
    for chosen in adversaries["icag"]:
        assert chosen[0] == NULL
        assert len(set(chosen)) == small_run.adversary.count


def test_icaa_rolls_out_version_j_in_round_j_and_produces_j_plus_1(small_run):
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, rounds=2))
    phases = METHODS["icaa"].phases(run)
    assert [(p.stage, p.round, p.policy_version, p.next_version) for p in phases] == [
        ("pretrain", 0, -1, 0),
        ("adapt", 0, 0, 1),
        ("adapt", 1, 1, 2),
        ("adapt", 2, 2, 3),
    ]
    for phase in phases[1:]:
        for job in METHODS["icaa"].ask(run, phase):
            assert job.policy_version == phase.round
            assert job.trials == run.icaa.trials + 1
            assert all(v.task.vector("start") == (0, 0) for v in job.variations)


def test_a_job_delivers_exactly_its_identities_and_one_version_acts_in_all(small_run, collected):
    trajectories, policies = collected
    method = METHODS["icaa"]
    wanted = [i for phase in method.phases(small_run) for job in method.ask(small_run, phase) for i in job.identities()]
    assert sorted(t.identity for t in trajectories) == sorted(wanted)
    assert {(t.identity.round, t.policy_version, t.weights_digest) for t in trajectories if t.identity.stage == "adapt"} == {
        (0, 0, "digest 0"),
        (1, 1, "digest 1"),
    }
    count = len(method.ask(small_run, method.phases(small_run)[1]))
    assert policies.asked == [0] * count + [1] * count


def test_no_test_goal_is_ever_trained_on(small_run, collected):
    held_out = {t.vector("goal") for t in splits.split(small_run).test}
    assert held_out
    assert not held_out & {t.variation.task.vector("goal") for t in collected[0]}


def test_the_same_job_repeats_itself_exactly(small_run, collected):
    _, policies = collected
    method = METHODS["icaa"]
    for phase in method.phases(small_run)[:2]:
        job = method.ask(small_run, phase)[1]
        for one, two in zip(jobs.do(job, policies, "a"), jobs.do(job, policies, "b"), strict=True):
            assert one.identity == two.identity
            assert all((a == b).all() for a, b in zip(one.arrays().values(), two.arrays().values(), strict=True))


def test_d0_labels_are_those_of_each_variations_optimal_policy(small_run, collected):
    for t in collected[0]:
        if t.identity.stage != "pretrain":
            continue
        truth = soft_labels(Hypotheses.of([t.variation]), small_run.darkroom.gamma, small_run.darkroom.label_slack)[0]
        np.testing.assert_array_equal(t.labels, truth[cell_numbers(t.queries, 3)])
        assert t.origin == "optimal"


def test_sampled_labels_are_single_optimal_actions(small_run):
    run = dataclasses.replace(small_run, darkroom=dataclasses.replace(small_run.darkroom, labels="sampled"))
    phase = METHODS["dpt"].phases(run)[0]
    for job in METHODS["dpt"].ask(run, phase):
        for t in jobs.do(job, Fixed, "w"):
            truth = soft_labels(Hypotheses.of([t.variation]), run.darkroom.gamma, run.darkroom.label_slack)[0]
            assert (t.labels.sum(axis=1) == 1).all() and (t.labels.max(axis=1) == 1).all()
            assert (truth[cell_numbers(t.queries, 3), t.labels.argmax(axis=1)] > 0).all()


def test_labels_come_from_strictly_later_trials_than_contexts(small_run, collected):
    data = Kept(collected[0])
    for trials in map(data.trials, data.variations("adapt", 0)):
        made = self_labelled(small_run, trials)
        cut = small_run.icaa.context_trials + 1
        np.testing.assert_array_equal(made.actions, np.stack([t.actions for t in trials[:cut]]))
        np.testing.assert_array_equal(made.queries, np.concatenate([t.observations[:-1] for t in trials[cut:]]))
        np.testing.assert_array_equal(made.labels.argmax(axis=1), np.concatenate([t.actions for t in trials[cut:]]))


def test_top_return_takes_the_better_half_of_the_later_trials(small_run, collected):
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, label_trials="top_return"))
    trials = Kept(collected[0]).trials(("adapt", 0, 0, 0))
    better = []
    for n, t in enumerate(trials):
        rewards = np.full(8, float(n == 3), np.float32)
        better.append(dataclasses.replace(t, rewards=rewards))
    made = self_labelled(run, better)
    assert len(made.queries) == 8 * 2
    np.testing.assert_array_equal(made.queries[:8], better[3].observations[:-1])


def test_each_round_learns_from_d0_and_all_rounds_so_far(small_run, collected):
    method, data = METHODS["icaa"], Kept(collected[0])
    first, second, third = (method.learn(small_run, phase, data) for phase in method.phases(small_run))
    variations = len(splits.split(small_run).train) * small_run.adversary.count
    assert [len(pool.examples) for pool in first] == [len(splits.split(small_run).train)]
    assert [len(pool.examples) for pool in second] == [len(first[0].examples), variations]
    assert [len(pool.examples) for pool in third] == [len(first[0].examples), 2 * variations]
    assert [pool.share for pool in third] == [1 - small_run.icaa.new_fraction, small_run.icaa.new_fraction]


def test_practice_adds_own_histories_from_the_origin_with_optimal_labels(small_run):
    """Rounds after D_pre: T^j acts, the optimal policy labels, contexts are histories as deployed."""
    dagger = DAggerConfig(rounds=2, trials=3, steps=7, learning_rate=0.5, new_fraction=0.25)
    run = dataclasses.replace(small_run, method="icag", dagger=dagger)
    method, data = METHODS["icag"], Kept([])
    policies = Fixed(splits.spec(run), run.model)
    phases = method.phases(run)
    assert [(p.stage, p.policy_version, p.next_version) for p in phases] == [
        ("pretrain", -1, 0),
        ("adapt", 0, 1),
        ("adapt", 1, 2),
    ]
    assert [(p.steps, p.learning_rate) for p in phases[1:]] == [(7, 0.5)] * 2
    variations = [v for i, task in enumerate(splits.split(run).train) for v in splits.variations(run, i, splits.deployed(task))]
    for phase in phases:
        asked = method.ask(run, phase)
        made = [t for job in asked for t in jobs.do(job, policies, "w")]
        data.trajectories += made
        pools = method.learn(run, phase, data)
        assert [len(pool.examples) for pool in pools] == [len(variations), phase.next_version * len(variations)][: len(pools)]
        assert len(pools) == 1 + (phase.stage == "adapt")
        if phase.stage == "pretrain":
            continue
        assert [v for job in asked for v in job.variations] == variations, "the variations of D_pre, not new ones"
        assert [pool.share for pool in pools] == [0.75, 0.25]
        assert [pool.episodes for pool in pools] == [run.optim.episodes, 3]
        assert {(t.policy_version, t.weights_digest) for t in made} == {(phase.round, f"digest {phase.round}")}
        for t in made:
            assert (t.observations[0] == 0).all()
            truth = soft_labels(Hypotheses.of([t.variation]), run.darkroom.gamma, run.darkroom.label_slack)[0]
            np.testing.assert_array_equal(t.labels, truth[cell_numbers(t.queries, 3)])
        mine = pools[1].examples[0]
        trials = data.trials(("adapt", 0, 0, 0))
        assert mine.history and len(trials) == 3
        np.testing.assert_array_equal(mine.actions, np.stack([t.actions for t in trials]))
        np.testing.assert_array_equal(mine.labels, np.concatenate([t.labels for t in trials]))
        assert not pools[0].examples[0].history
    assert len({tuple(t.actions) for t in data.trials(("adapt", 0, 0, 1)) + data.trials(("adapt", 1, 0, 1))}) == 6


def test_practice_makes_histories_by_every_rule_of_deployment(small_run):
    """Job by job, and in each round other jobs by another; without windows there is one rule."""
    dagger = DAggerConfig(rounds=3, trials=2)
    plain = dataclasses.replace(small_run, method="icag", dagger=dagger)
    run = dataclasses.replace(
        plain,
        model=dataclasses.replace(plain.model, window=3),
        pretrain=dataclasses.replace(plain.pretrain, windows=1),
        optim=dataclasses.replace(plain.optim, windows=1),
    )

    def rules(run, number):
        phase = METHODS["icag"].phases(run)[number]
        return [job.setting("deploy") for job in METHODS["icag"].ask(run, phase)]

    assert set(rules(plain, 1)) == {"paper"}
    rounds = [rules(run, number) for number in (1, 2, 3)]
    assert all(sorted(one) == ["committed", "paper", "paper"] for one in zip(*rounds, strict=True)) and len(rounds[0]) > 1
    assert rounds[0][:2] == ["paper", "committed"]


def test_behaviours_take_turns(small_run):
    """Trial n of every variation walks as behavior n modulo their number."""
    behaviors = ("sweep", "random")
    run = dataclasses.replace(small_run, pretrain=dataclasses.replace(small_run.pretrain, behaviors=behaviors))
    found = {}
    for setting in (run, small_run):
        phase = METHODS["dpt"].phases(setting)[0]
        made = [t for job in METHODS["dpt"].ask(setting, phase) for t in jobs.do(job, Fixed, "w")]
        found[setting.pretrain.behaviors] = {t.identity: t.actions.tolist() for t in made}
    same = {i: actions == found["random",][i] for i, actions in found[behaviors].items()}
    assert all(equal == (identity.trial % 2 == 1) for identity, equal in same.items()), "only the random walks are as they were"


def test_an_unknown_job_is_refused(small_run):
    job = METHODS["dpt"].ask(small_run, METHODS["dpt"].phases(small_run)[0])[0]
    with pytest.raises(ValueError, match="'dance'"):
        jobs.do(dataclasses.replace(job, kind="dance"), Fixed, "w")


def test_an_identity_names_its_draws():
    one = Identity("adapt", 0, 1, 2, 3).rng(7).random(4)
    np.testing.assert_array_equal(Identity("adapt", 0, 1, 2, 3).rng(7).random(4), one)
    assert (Identity("adapt", 0, 1, 3, 2).rng(7).random(4) != one).any()
    assert (Identity("adapt", 0, 1, 2, 3).rng(8).random(4) != one).any()
