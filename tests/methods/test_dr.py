"""Domain randomisation: ICAG's variations, labels of the undisturbed optimum."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run, load_run
from icrl_dist.config.sections import AdversaryConfig, DAggerConfig
from icrl_dist.methods import registry as methods
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.stream import wire
from icrl_dist.types import Variation
from tests.jobs import FixedWeights, collect, decoded


def test_labels_are_those_of_the_task_without_its_adversary_in_the_same_disturbed_episodes(small_run: Run) -> None:
    """Also of action windows and in rounds after pretraining; ICAG's labels of the same queries differ somewhere."""
    icag = dataclasses.replace(
        small_run,
        method="icag",
        adversary=AdversaryConfig(count=2, p_max=1.0),
        dagger=DAggerConfig(rounds=1, trials=2),
        model=dataclasses.replace(small_run.model, window=3),
        pretrain=dataclasses.replace(small_run.pretrain, windows=1, decoy_fraction=0.0, queries=9),
        optim=dataclasses.replace(small_run.optim, windows=1),
    )
    dr, weights, room = dataclasses.replace(icag, method="dr"), FixedWeights(icag), icag.section("darkroom")
    assert methods.of(dr).phases(dr) == methods.of(icag).phases(icag)
    for phase in methods.of(dr).phases(dr):
        jobs = methods.of(dr).ask(dr, phase)
        assert [decoded(dr, wire.encode_job(job)) for job in jobs] == list(jobs), "a worker gets another job"
        made, theirs = (sorted(collect(run, phase, weights), key=lambda t: t.identity) for run in (dr, icag))
        differing = 0
        for t, other in zip(made, theirs, strict=True):
            assert (t.identity, t.variation, t.origin) == (other.identity, other.variation, "optimal")
            for name in ("observations", "actions", "rewards", "adversary"):
                np.testing.assert_array_equal(getattr(t, name), getattr(other, name))
            truth, disturbed = (
                soft_labels(Hypotheses.of([one]), room.gamma, room.label_slack)[0]
                for one in (Variation(t.variation.task), t.variation)
            )
            assert len(t.prev_actions) == 3
            np.testing.assert_array_equal(t.labels, truth[cell_numbers(t.queries, 3)])
            np.testing.assert_array_equal(other.labels, disturbed[cell_numbers(other.queries, 3)])
            differing += int((t.labels[:9] != other.labels[:9]).any())
        assert differing, "no adversary changes the optimum, so the test shows nothing"


def test_a_continuous_problem_is_refused_with_what_works_instead() -> None:
    for name in ("metaworld-laptop", "dmc-cartpole-balance-laptop"):
        with pytest.raises(
            ConfigError, match=r"method = 'dr': \S+ cannot label disturbed .* undisturbed optimum: use icag or dpt"
        ):
            load_run(name, "method=dr")
