"""DPT's dataset D_pre, which ICAA shares as D^0, against Algorithm 2."""

from __future__ import annotations

import dataclasses

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.methods import registry as methods
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from tests.jobs import collect, in_problem
from tests.methods.conftest import Collected


def dpt(run: Run) -> Run:
    return dataclasses.replace(run, method="dpt")


def test_d0_labels_are_those_of_the_optimal_policy_of_each_variation(small_run: Run, collected: Collected) -> None:
    pretrain = [t for t in collected.trajectories if t.identity.stage == "pretrain"]
    assert pretrain
    for t in pretrain:
        room = small_run.section("darkroom")
        truth = soft_labels(Hypotheses.of([t.variation]), room.gamma, room.label_slack)[0]
        np.testing.assert_array_equal(t.labels, truth[cell_numbers(t.queries, 3)])
        assert t.origin == "optimal"


def test_sampled_labels_are_single_optimal_actions(small_run: Run) -> None:
    room = dataclasses.replace(small_run.section("darkroom"), labels="sampled")
    run = in_problem(dpt(small_run), "darkroom", darkroom=room)
    made = collect(run, methods.of(run).phases(run)[0])
    assert made
    for t in made:
        truth = soft_labels(Hypotheses.of([t.variation]), room.gamma, room.label_slack)[0]
        assert (t.labels.sum(axis=1) == 1).all() and (t.labels.max(axis=1) == 1).all()
        assert (truth[cell_numbers(t.queries, 3), t.labels.argmax(axis=1)] > 0).all()


def test_trials_take_the_behavior_policies_in_turn(small_run: Run) -> None:
    """Trial n of every variation follows behavior policy n modulo their number."""
    behaviors = ("sweep", "random")
    one = dpt(small_run)
    both = dataclasses.replace(one, pretrain=dataclasses.replace(one.pretrain, behaviors=behaviors))
    found = {}
    for run in (both, one):
        made = collect(run, methods.of(run).phases(run)[0])
        found[run.pretrain.behaviors] = {t.identity: t.actions.tolist() for t in made}
    same = {i: actions == found["random",][i] for i, actions in found[behaviors].items()}
    assert all(equal == (identity.trial % 2 == 1) for identity, equal in same.items()), "only the random walks stay the same"
