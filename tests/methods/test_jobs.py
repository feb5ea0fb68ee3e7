"""The jobs that methods ask for, and the plan of phases that asks once."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Phase
from icrl_dist.methods import registry as methods
from icrl_dist.methods.icaa import ICAA
from icrl_dist.problems import registry as problems
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.fork import Lineage
from icrl_dist.types import Identity, Job
from learner.phases import PhasePlan
from tests.jobs import do


def test_every_method_shares_out_the_same_number_of_contexts(small_run: Run) -> None:
    for name in ("dpt", "icag", "icaa"):
        run = dataclasses.replace(small_run, method=name)
        method = methods.of(run)
        jobs = method.ask(run, method.phases(run)[0])
        assert sum(job.tasks for job in jobs) == len(problems.of(run).split.train)
        assert all(job.tasks <= run.stream.job_tasks for job in jobs)
        assert sum(len(job.variations) * job.trials for job in jobs) == run.pretrain.contexts
        assert all(job.policy_version == -1 for job in jobs)


def test_the_plan_of_phases_asks_the_method_once_a_phase(small_run: Run, tmp_path: Path) -> None:
    asked: Counter[Phase] = Counter()

    class Counting(ICAA):
        def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
            asked[phase] += 1
            return super().ask(run, phase)

    method = Counting()
    store = Dataset(tmp_path / "dataset")
    plan = PhasePlan(small_run, Lineage(small_run), method)
    plan.store = store
    for _ in range(3):
        for phase in plan.phases:
            assert not plan.is_complete(phase)
            assert plan.incomplete(phase) == list(plan.ask(phase)) == list(methods.of(small_run).ask(small_run, phase))
            assert plan.ask(phase) is plan.ask(phase)
        plan.recheck()
    assert plan.next(-1) == plan.phases[0]
    assert asked == dict.fromkeys(plan.phases, 1) and len(asked) == 3
    store.close()


def test_a_job_of_an_unknown_kind_is_refused(icag_run: Run) -> None:
    method = methods.of(icag_run)
    job = method.ask(icag_run, method.phases(icag_run)[0])[0]
    with pytest.raises(ValueError, match="'dance'"):
        do(icag_run, dataclasses.replace(job, kind="dance"))


def test_an_identity_keys_its_draws() -> None:
    one = Identity("adapt", 0, 1, 2, 3).rng(7).random(4)
    np.testing.assert_array_equal(Identity("adapt", 0, 1, 2, 3).rng(7).random(4), one)
    assert (Identity("adapt", 0, 1, 3, 2).rng(7).random(4) != one).any()
    assert (Identity("adapt", 0, 1, 2, 3).rng(8).random(4) != one).any()
