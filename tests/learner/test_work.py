"""The Board with a fake clock: what is leased, to whom, and what comes back."""

import pytest

from icrl_dist.recipes import METHODS
from icrl_dist.types import Identity
from learner.work import Board

LEASE = 10.0


@pytest.fixture
def jobs(small_run):
    return METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[:3]


@pytest.fixture
def board(jobs):
    made = Board(LEASE)
    made.open(jobs, [])
    return made


def finish(board, job, now=0.0):
    for identity in job.identities():
        board.received(identity, now)


def test_every_job_is_leased_once_and_then_there_is_nothing(board, jobs):
    assert [board.lease(f"w{i}", 0.0) for i in range(4)] == [*jobs, None]
    assert not board.done
    for job in jobs:
        finish(board, job)
    assert board.done and board.arrived == board.expected == sum(len(list(j.identities())) for j in jobs)


def test_an_expired_lease_goes_out_again_and_a_live_one_does_not(board, jobs):
    for worker in "abc":
        board.lease(worker, 0.0)
    assert board.lease("d", LEASE - 0.01) is None
    assert board.lease("d", LEASE) == jobs[0]
    assert board.lease("e", LEASE) == jobs[1]
    assert board.leases == 5


def test_a_trajectory_extends_the_lease_of_its_job(board, jobs):
    for worker in "abc":
        board.lease(worker, 0.0)
    board.received(next(iter(jobs[0].identities())), 5.0)
    assert board.lease("d", LEASE + 1) == jobs[1]
    assert board.lease("e", LEASE + 4.9) == jobs[2]
    assert board.lease("f", LEASE + 4.9) is None
    assert board.lease("f", LEASE + 5.0) == jobs[0]


def test_the_job_of_a_lost_worker_is_free_at_once(board, jobs):
    for worker in "abc":
        board.lease(worker, 0.0)
    assert board.lost("b") == [jobs[1]]
    assert board.lost("b") == []
    assert board.lease("d", 0.1) == jobs[1]


def test_a_worker_that_asks_again_gets_back_what_it_held(board, jobs):
    assert board.lease("a", 0.0) == jobs[0]
    assert board.lease("a", 0.1) == jobs[0]


def test_a_finished_job_is_not_leased_again(board, jobs):
    board.lease("a", 0.0)
    finish(board, jobs[0])
    assert board.lost("a") == []
    assert board.lease("b", 2 * LEASE) == jobs[1]


def test_what_is_stored_already_is_not_asked_for(jobs):
    board = Board(LEASE)
    stored = [i for job in jobs[:2] for i in job.identities()]
    some = list(jobs[2].identities())[:2]
    board.open(jobs, [*stored, *some])
    assert board.arrived == len(stored) + 2
    assert board.lease("a", 0.0) == jobs[2]
    assert board.lease("b", 0.0) is None
    assert board.wants(some[0]) is None
    finish(board, jobs[2])
    assert board.done


def test_duplicates_and_strangers_count_for_nothing(board, jobs):
    identity = next(iter(jobs[0].identities()))
    board.received(identity, 0.0)
    board.received(identity, 0.0)
    board.received(Identity("adapt", 9, 9, 9, 9), 0.0)
    assert board.arrived == 1
    assert board.wants(identity) is None
    assert board.wants(identity._replace(trial=1)) == jobs[0]
    assert board.wants(Identity("adapt", 9, 9, 9, 9)) is None


def test_a_job_that_keeps_failing_ends_the_run_with_its_last_error(board, jobs):
    for _ in range(2):
        assert board.lease("a", 0.0) == jobs[0]
        assert board.failed(jobs[0].name, "ValueError: no") is None
    board.lease("a", 0.0)
    assert board.failed(jobs[0].name, "ValueError: still no") == "job pretrain/0/0 failed 3 times, last: ValueError: still no"
