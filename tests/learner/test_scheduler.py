"""The scheduler with a fake clock: leases, phases, policy versions and deadlines."""

import pytest

from icrl_dist.types import Identity
from learner.scheduler import LeaseScheduler
from tests.learner.scheduling import LEASE, PHASE, finish, jobs, kill, later, leased, nothing_stored, scheduler
from tests.optional import known

__all__ = ["jobs", "later", "scheduler"]


# Leases.


def test_every_job_is_leased_once(scheduler, jobs):
    assert [leased(scheduler, f"w{i}") for i in range(4)] == [*jobs, None]
    assert not scheduler.done(*PHASE)
    for job in jobs:
        finish(scheduler, job)
    assert scheduler.done(*PHASE) and scheduler.progress(*PHASE) == (36, 36)


def test_a_job_is_leased_again_only_after_its_lease_expires(scheduler, jobs):
    for worker in "abc":
        leased(scheduler, worker)
    assert leased(scheduler, "d", LEASE - 0.01) is None
    assert leased(scheduler, "d", LEASE) == jobs[0]
    assert leased(scheduler, "e", LEASE) == jobs[1]
    assert scheduler.leases(*PHASE) == 5


def test_a_trajectory_extends_the_lease_of_its_job(scheduler, jobs):
    for worker in "abc":
        leased(scheduler, worker)
    scheduler.received(next(iter(jobs[0].identities())), 5.0)
    assert leased(scheduler, "d", LEASE + 1) == jobs[1]
    assert leased(scheduler, "e", LEASE + 4.9) == jobs[2]
    assert leased(scheduler, "f", LEASE + 4.9) is None
    assert leased(scheduler, "f", LEASE + 5.0) == jobs[0]


def test_a_repeated_trajectory_extends_the_lease_and_is_not_measured(scheduler, jobs):
    first, second = list(jobs[0].identities())[:2]
    leased(scheduler, "a")
    scheduler.received(first, 0.5)
    kill(scheduler, "a", 1.0)
    leased(scheduler, "b", 1.0)
    scheduler.repeated(first, 9.0)
    scheduler.received(second, 9.1)
    scheduler.repeated(Identity("adapt", 9, 0, 0, 0), 9.1)
    assert scheduler.lease("c", 9.1).deadline_s == pytest.approx(4 * 0.5)


def test_the_job_of_a_lost_worker_is_free_at_once(scheduler, jobs):
    for worker in "abc":
        leased(scheduler, worker)
    assert kill(scheduler, "b") == [jobs[1]]
    assert kill(scheduler, "b") == []
    assert leased(scheduler, "d", 0.1) == jobs[1]


def test_a_worker_that_asks_again_gets_its_job_again(scheduler, jobs):
    assert leased(scheduler, "a") == jobs[0]
    assert leased(scheduler, "a", 0.1) == jobs[0]


def test_a_finished_job_is_not_leased_again(scheduler, jobs):
    leased(scheduler, "a")
    finish(scheduler, jobs[0])
    assert kill(scheduler, "a") == []
    assert leased(scheduler, "b", 2 * LEASE) == jobs[1]


def test_stored_trajectories_are_not_collected_again(jobs):
    scheduler = LeaseScheduler(LEASE)
    some = list(jobs[2].identities())[:2]
    scheduler.open(jobs, lambda job: some if job == jobs[2] else set(job.identities()))
    assert scheduler.progress(*PHASE) == (26, 36)
    assert leased(scheduler, "a") == jobs[2]
    assert leased(scheduler, "b") is None
    assert scheduler.pending_job(some[0]) is None
    finish(scheduler, jobs[2])
    assert scheduler.done(*PHASE) and scheduler.progress(*PHASE) == (36, 36)


def test_duplicates_and_unknown_identities_are_not_counted(scheduler, jobs):
    identity = next(iter(jobs[0].identities()))
    unknown = [Identity("adapt", 9, 9, 9, 9), *(identity._replace(**{name: 9}) for name in ("task", "variation", "trial"))]
    for one in (identity, identity, *unknown):
        scheduler.received(one, 0.0)
    assert scheduler.progress(*PHASE) == (1, 36)
    assert [scheduler.pending_job(one) for one in (identity, *unknown)] == [None] * 5
    assert scheduler.pending_job(identity._replace(trial=1)) == jobs[0]


# Phases.


def test_several_phases_are_open_and_the_first_is_leased_first(scheduler, jobs, later):
    scheduler.open(later, nothing_stored)
    assert [leased(scheduler, f"w{i}") for i in range(7)] == [*jobs, *later, None]
    finish(scheduler, later[0])
    assert (scheduler.progress("adapt", 1), scheduler.progress(*PHASE)) == ((12, 36), (0, 36))
    for job in jobs:
        finish(scheduler, job)
    assert scheduler.done(*PHASE) and not scheduler.done("adapt", 1)
    assert (scheduler.leases(*PHASE), scheduler.leases("adapt", 1)) == (3, 3)


def test_a_closed_phase_needs_nothing_and_counts_no_failures(scheduler, jobs, later):
    leased(scheduler, "a")
    scheduler.open(later, nothing_stored)
    scheduler.close(*PHASE)
    identity = next(iter(jobs[0].identities()))
    assert scheduler.pending_job(identity) is None
    scheduler.received(identity, 1.0)
    scheduler.job_failed("a", jobs[0].name, "raised")
    assert kill(scheduler, "a") == []
    scheduler.worker_back("a")
    assert (scheduler.progress(*PHASE), scheduler.done(*PHASE), scheduler.leases(*PHASE)) == ((0, 0), True, 0)
    assert leased(scheduler, "b") == later[0]


def test_a_phase_opened_again_starts_from_zero(scheduler, jobs):
    leased(scheduler, "a")
    finish(scheduler, jobs[1])
    scheduler.open(jobs, nothing_stored)
    assert scheduler.progress(*PHASE) == (0, 36)
    assert kill(scheduler, "a") == []
    assert [leased(scheduler, w) for w in "bcd"] == list(jobs)


def test_jobs_of_two_phases_at_once_are_refused(scheduler, jobs, later):
    with pytest.raises(ValueError, match="jobs of 2 phases"):
        scheduler.open([jobs[0], later[0]], nothing_stored)


# Weights.


def test_a_job_keeps_the_policy_version_of_its_first_lease(scheduler, later):
    scheduler.close(*PHASE)
    scheduler.open(later, nothing_stored)
    newest = {"version": 3}

    def policy_version(job):
        return newest["version"]

    assert leased(scheduler, "a", policy_version=policy_version).policy_version == 3
    newest["version"] = 4
    assert leased(scheduler, "b", policy_version=policy_version).policy_version == 4
    kill(scheduler, "a")
    again = leased(scheduler, "c", policy_version=policy_version)
    assert (again.task, again.policy_version) == (later[0].task, 3)
    assert scheduler.pending_job(next(iter(later[0].identities()))).policy_version == 3
    kill(scheduler, "c")
    scheduler.lease("d", 0.0, policy_version)
    parts = [leased(scheduler, f"p{i}", policy_version=policy_version) for i in range(6)]
    assert {part.policy_version for part in parts if part.task in (later[0].task, later[0].task + 1)} == {3}


# Deadlines.


def test_the_deadline_is_a_multiple_of_the_longest_gap_measured(scheduler, jobs, later):
    identities = list(jobs[0].identities())
    assert scheduler.lease("a", 100.0).deadline_s == LEASE
    scheduler.received(identities[0], 100.6)
    scheduler.received(identities[1], 100.7)
    assert scheduler.lease("b", 101.0).deadline_s == pytest.approx(4 * 0.6)
    scheduler.received(identities[2], 102.2)
    assert scheduler.lease("c", 103.0).deadline_s == pytest.approx(4 * 1.5)
    scheduler.open(later, nothing_stored)
    assert scheduler.lease("d", 103.0).deadline_s == LEASE, "no gap of that kind has been measured"


def test_the_deadline_stays_within_its_bounds(jobs):
    for gap, expected in ((0.001, 1.0), (9.0, LEASE)):
        scheduler = LeaseScheduler(LEASE, floor_s=1.0, factor=4.0)
        scheduler.open(jobs, nothing_stored)
        scheduler.lease("a", 0.0)
        scheduler.received(next(iter(jobs[0].identities())), gap)
        assert known(scheduler.lease("b", gap)).deadline_s == expected


def test_a_trajectory_of_a_free_job_is_not_measured(scheduler, jobs):
    identities = iter(jobs[0].identities())
    leased(scheduler, "a")
    scheduler.received(next(identities), 0.5)
    kill(scheduler, "a", 1.0)
    scheduler.received(next(identities), 9.0)
    assert scheduler.lease("b", 9.0).deadline_s == pytest.approx(4 * 0.5 * 2), "its job has come back once"


def test_the_deadline_doubles_each_time_the_job_comes_back(scheduler, jobs):
    now = 0.0
    for expected in (LEASE, 2 * LEASE, 4 * LEASE):
        lease = scheduler.lease(f"w{now}", now)
        assert (lease.job, lease.deadline_s) == (jobs[0], expected)
        now += expected
    kill(scheduler, "w0.0", now)
    assert scheduler.lease("z", now).deadline_s == 16 * LEASE
    assert scheduler.lease("y", now).deadline_s == LEASE, "only for that job"
