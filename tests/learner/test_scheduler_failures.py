"""The scheduler with a fake clock: deaths, exceptions, lost nodes, parts of jobs and quarantines."""

import dataclasses

import pytest

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.payloads import ExpertHistories, ExpertLabelling
from icrl_dist.types import Identity
from learner.scheduler import LeaseScheduler
from tests.learner.scheduling import LEASE, PHASE, finish, jobs, kill, later, leased, nothing_stored, scheduler, split_first_job
from tests.optional import known

__all__ = ["jobs", "later", "scheduler"]


def test_after_one_death_a_job_is_leased_whole(scheduler, jobs):
    leased(scheduler, "a")
    kill(scheduler, "a")
    assert leased(scheduler, "b") == jobs[0]


def test_after_two_deaths_a_job_is_leased_in_parts_after_the_other_jobs(scheduler, jobs):
    stored = [i for i in jobs[0].identities() if i.variation == 1 or (i.task, i.trial) == (0, 0)]
    for worker in ("x", "y"):
        leased(scheduler, worker)
        kill(scheduler, worker)
    for identity in stored:
        scheduler.received(identity, 0.0)
    first = leased(scheduler, "a")
    assert (first.task, first.first, first.variations) == (0, 0, jobs[0].variations[:1])
    order = [leased(scheduler, f"w{i}") for i in range(6)]
    assert order[:2] == list(jobs[1:]) and order[5] is None
    parts = [first, *order[2:5]]
    assert [(p.task, p.first, p.tasks, len(p.variations), p.trials) for p in parts] == [
        (t, v, 1, 1, 2) for t, v in ((0, 0), (0, 2), (1, 0), (1, 2))
    ]
    assert scheduler.pending_job(Identity("pretrain", 0, 1, 2, 1)) == parts[3]
    for part in parts:
        assert all(jobs[0].variation(i) == part.variation(i) for i in part.identities())
        finish(scheduler, part)
    for job in jobs[1:]:
        finish(scheduler, job)
    assert scheduler.done(*PHASE) and scheduler.progress(*PHASE) == (36, 36)


def test_a_variation_is_quarantined_at_its_third_death_and_the_others_finish(scheduler, jobs):
    split_first_job(scheduler)
    failing = leased(scheduler, "a")
    scheduler.received(next(iter(failing.identities())), 0.0)
    assert kill(scheduler, "a", cause="worker a died") == []
    assert scheduler.quarantined == {("pretrain", 0, 0, 0): "worker a died"}
    assert scheduler.pending_job(Identity("pretrain", 0, 0, 0, 1)) is None
    assert scheduler.progress(*PHASE) == (1, 35)
    while (job := leased(scheduler, "b")) is not None:
        finish(scheduler, job)
    assert scheduler.done(*PHASE) and scheduler.progress(*PHASE) == (35, 35)
    assert scheduler.quarantine_causes(*PHASE) == scheduler.quarantine_causes() == [("pretrain/0/0/0", "worker a died")]
    assert scheduler.quarantine_causes("adapt", 0) == []
    scheduler.close(*PHASE)
    assert scheduler.quarantine_causes(*PHASE) == [("pretrain/0/0/0", "worker a died")]


def test_a_part_that_finishes_is_not_quarantined(scheduler, jobs):
    split_first_job(scheduler)
    part = leased(scheduler, "a")
    finish(scheduler, part)
    assert kill(scheduler, "a") == [] and scheduler.quarantine_causes() == []


def test_a_job_of_one_variation_is_quarantined_at_its_third_death(jobs):
    single = dataclasses.replace(jobs[0], variations=jobs[0].variations[:1], tasks=1)
    scheduler = LeaseScheduler(LEASE)
    scheduler.open([single], nothing_stored)
    for worker in "ab":
        assert leased(scheduler, worker) == single
        assert kill(scheduler, worker) == [single] and not scheduler.quarantined
    assert leased(scheduler, "c") == single
    assert kill(scheduler, "c") == []
    assert scheduler.quarantine_causes() == [("pretrain/0/0/0", "it died")] and scheduler.done(*PHASE)
    assert scheduler.progress(*PHASE) == (0, 0)


def test_an_exception_counts_like_a_death_and_is_the_cause(jobs):
    single = dataclasses.replace(jobs[0], variations=jobs[0].variations[:1], tasks=1)
    scheduler = LeaseScheduler(LEASE)
    scheduler.open([single], nothing_stored)
    for _ in range(3):
        assert not scheduler.quarantined
        leased(scheduler, "a")
        scheduler.job_failed("a", ("pretrain", 0, 0, 2), "a job that it does not hold")
        scheduler.job_failed("b", single.name, "a worker that holds nothing")
        scheduler.job_failed("a", single.name, "ValueError: no")
        scheduler.job_failed("a", single.name, "reported twice")
    assert scheduler.quarantine_causes() == [("pretrain/0/0/0", "ValueError: no")]


def test_a_death_after_the_lease_expired_is_counted(scheduler, jobs):
    leased(scheduler, "stuck")
    assert leased(scheduler, "other", LEASE) == jobs[0]
    assert kill(scheduler, "stuck", LEASE) == [], "the other worker holds it"
    kill(scheduler, "other", LEASE)
    assert len(leased(scheduler, "a", LEASE).variations) == 1


def test_a_job_is_not_split_while_a_worker_holds_it(scheduler, jobs):
    leased(scheduler, "a")
    assert leased(scheduler, "b", LEASE) == jobs[0]
    kill(scheduler, "a", LEASE)
    assert leased(scheduler, "c", 3 * LEASE) == jobs[0]
    kill(scheduler, "b", 3 * LEASE)
    finish(scheduler, jobs[0], 3 * LEASE)
    assert scheduler.progress(*PHASE) == (12, 36) and leased(scheduler, "d", 3 * LEASE) == jobs[1]


def test_a_worker_that_is_back_still_holds_its_job(scheduler, jobs):
    for _ in range(5):
        leased(scheduler, "a")
        assert kill(scheduler, "a") == [jobs[0]]
        scheduler.worker_back("a")
        assert leased(scheduler, "b", 0.1) == jobs[1], "a holds the first job"
        scheduler.worker_lost("b", 0.1)
        scheduler.worker_back("b")
    kill(scheduler, "a")
    assert leased(scheduler, "c") == jobs[0], "whole: only one death is counted"


def test_a_lost_worker_that_asks_is_back(scheduler, jobs):
    for _ in range(5):
        assert leased(scheduler, "a") == jobs[0]
        kill(scheduler, "a")
    assert leased(scheduler, "b") == jobs[0], "whole: only the last death is counted"
    scheduler.worker_back("a")
    scheduler.worker_back("a")
    kill(scheduler, "b")
    assert leased(scheduler, "c") == jobs[0], "the last one was taken back too"


def test_a_death_after_one_that_was_taken_back_is_counted(scheduler, jobs):
    leased(scheduler, "a")
    kill(scheduler, "a")
    scheduler.worker_back("a")
    assert kill(scheduler, "a") == [jobs[0]]
    leased(scheduler, "b")
    kill(scheduler, "b")
    assert len(leased(scheduler, "c").variations) == 1


def test_workers_lost_with_their_nodes_are_not_counted(scheduler, jobs):
    for worker in "abc":
        assert leased(scheduler, worker) == jobs[0]
        assert kill(scheduler, worker) == [jobs[0]]
        scheduler.lost_with_node(worker)
        scheduler.lost_with_node(worker)
    scheduler.lost_with_node("d")  # the fleet may report it before the scheduler detects the death
    assert leased(scheduler, "d") == jobs[0] and kill(scheduler, "d") == [jobs[0]]
    scheduler.lost_with_node("unknown")
    assert scheduler.lease("e", 0.0).deadline_s == LEASE, "and the next lease is not longer"


def test_a_loss_with_a_node_is_taken_back_from_the_parts_of_a_job(scheduler, jobs):
    split_first_job(scheduler)
    part = leased(scheduler, "a")
    scheduler.lost_with_node("x")
    assert kill(scheduler, "a") == [part], "its second death"
    for name in ("b", "c"):
        finish(scheduler, leased(scheduler, name))
    while (again := leased(scheduler, "d")) != part:
        finish(scheduler, again)
    kill(scheduler, "d")
    assert list(scheduler.quarantined) == [part.name]


def test_a_variation_quarantined_because_of_lost_nodes_is_leased_again(scheduler, jobs):
    split_first_job(scheduler)
    part = leased(scheduler, "a")
    scheduler.received(next(iter(part.identities())), 0.0)
    kill(scheduler, "a")
    assert list(scheduler.quarantined) == [part.name] and scheduler.progress(*PHASE) == (1, 35)
    scheduler.lost_with_node("a")
    assert not scheduler.quarantined and scheduler.progress(*PHASE) == (1, 36) and not scheduler.done(*PHASE)
    assert scheduler.pending_job(list(part.identities())[1]) == part
    while (job := leased(scheduler, "b")) is not None:
        finish(scheduler, job)
    assert scheduler.done(*PHASE)


def test_a_quarantine_of_a_closed_phase_stays(scheduler, jobs):
    split_first_job(scheduler)
    part = leased(scheduler, "a")
    kill(scheduler, "a")
    scheduler.close(*PHASE)
    scheduler.lost_with_node("a")
    assert list(scheduler.quarantined) == [part.name]
    scheduler.open(jobs, nothing_stored)
    scheduler.lost_with_node("x")
    assert leased(scheduler, "b") == jobs[0]


def test_causes_are_listed_in_canonical_order(jobs, later):
    scheduler = LeaseScheduler(LEASE)
    one = [
        dataclasses.replace(jobs[0], task=t, variations=jobs[0].variations[:1], tasks=1, first=v)
        for t in (10, 9)
        for v in (2, 1)
    ]
    scheduler.open([dataclasses.replace(job, stage="adapt") for job in one], nothing_stored)
    scheduler.open(one, nothing_stored)
    while (job := leased(scheduler, "a")) is not None:
        scheduler.job_failed("a", job.name, "no")
    names = [name for name, _ in scheduler.quarantine_causes()]
    assert names == [f"{s}/0/{t}/{v}" for s in ("pretrain", "adapt") for t in (9, 10) for v in (1, 2)]
    assert [name for name, _ in scheduler.quarantine_causes("adapt")] == names[4:]
    scheduler.open(one, nothing_stored)
    assert [name for name, _ in scheduler.quarantine_causes()] == names[4:], "a phase opened again has no causes"


# Jobs that take long before their first trajectory.


@pytest.fixture
def training(jobs):
    payload = ExpertHistories(SACConfig(), ExpertLabelling(queries=4, window=1, windows=0, decoy_fraction=0.0))
    return [dataclasses.replace(job, kind=payload.kind, payload=payload) for job in jobs]


def test_an_expert_from_a_cache_does_not_shorten_the_lease_of_a_training(training):
    scheduler = LeaseScheduler(LEASE, floor_s=0.1, factor=2.0)
    scheduler.open(training, nothing_stored)
    scheduler.lease("a", 0.0)
    finish(scheduler, training[0], 0.01)
    assert known(scheduler.lease("a", 0.02)).deadline_s == LEASE


def test_failures_of_a_training_that_gets_further_each_time_are_forgotten(training):
    scheduler = LeaseScheduler(LEASE)
    scheduler.open(training[:1], nothing_stored)
    for death in range(6):
        assert leased(scheduler, f"w{death}") == training[0], "whole: parts would start from the beginning"
        scheduler.reached(f"w{death}", training[0].label, 1000 * (death + 1))
        scheduler.reached(f"w{death}", "another job", 10**9)
        kill(scheduler, f"w{death}")
    leased(scheduler, "w6")
    scheduler.reached("w6", training[0].label, 6000)  # no further than before
    kill(scheduler, "w6")
    assert len(leased(scheduler, "w7").variations) == 1
