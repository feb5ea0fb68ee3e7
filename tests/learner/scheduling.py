"""Jobs, a scheduler and short actions for the tests of the scheduler."""

import dataclasses

import pytest

from learner.scheduler import LeaseScheduler
from tests.jobs import jobs_of

LEASE = 10.0
PHASE = ("pretrain", 0)


@pytest.fixture
def jobs(small_run):
    """Three jobs of two tasks with three variations each, two trials."""
    first_jobs = jobs_of(small_run, "icag")[:3]
    assert [(len(job.variations), job.tasks, job.trials) for job in first_jobs] == [(6, 2, 2)] * 3
    return first_jobs


def nothing_stored(job):
    return ()


@pytest.fixture
def scheduler(jobs):
    opened = LeaseScheduler(LEASE, floor_s=1.0, factor=4.0)
    opened.open(jobs, nothing_stored)
    return opened


def leased(scheduler, worker, now=0.0, policy_version=None):
    lease = scheduler.lease(worker, now, policy_version)
    return lease.job if lease else None


def finish(scheduler, job, now=0.0):
    for identity in job.identities():
        scheduler.received(identity, now)


def kill(scheduler, worker, now=0.0, cause="it died"):
    return scheduler.worker_lost(worker, now, cause)


def split_first_job(scheduler):
    """The first job's worker dies twice; its parts come after the other two jobs."""
    for worker in ("x", "y"):
        leased(scheduler, worker)
        kill(scheduler, worker)


@pytest.fixture
def later(jobs):
    return [dataclasses.replace(job, kind="adapt", stage="adapt", round=1, policy_version=1) for job in jobs]
