"""The Board with a fake clock: what is leased, to whom, what comes back, and who is to blame."""

import collections
import dataclasses

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from icrl_dist.methods.recipes import METHODS
from icrl_dist.types import Identity
from learner.scheduler import Board

LEASE = 10.0
PHASE = ("pretrain", 0)


@pytest.fixture
def jobs(small_run):
    """Three jobs of two tasks with three variations each, two trials."""
    asked = METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[:3]
    assert [(len(job.variations), job.tasks, job.trials) for job in asked] == [(6, 2, 2)] * 3
    return asked


def nothing(job):
    return ()


@pytest.fixture
def board(jobs):
    made = Board(LEASE, floor_s=1.0, factor=4.0)
    made.open(jobs, nothing)
    return made


def leased(board, worker, now=0.0, acting=None):
    lease = board.lease(worker, now, acting)
    return lease.job if lease else None


def finish(board, job, now=0.0):
    for identity in job.identities():
        board.received(identity, now)


def kill(board, worker, now=0.0, cause="it died"):
    return board.lost(worker, now, cause)


def split_first(board):
    """The first job's worker dies twice; its parts are behind the other two jobs."""
    for worker in ("x", "y"):
        leased(board, worker)
        kill(board, worker)


# Jobs that take long before their first trajectory.


@pytest.fixture
def training(jobs):
    return [dataclasses.replace(job, kind="train_expert") for job in jobs]


def test_what_comes_from_a_cache_at_once_shortens_no_training_of_experts(training):
    board = Board(LEASE, floor_s=0.1, factor=2.0)
    board.open(training, nothing)
    board.lease("a", 0.0)
    finish(board, training[0], 0.01)
    assert board.lease("a", 0.02).deadline_s == LEASE


def test_a_training_that_gets_further_in_every_life_is_not_to_blame_for_their_ends(training):
    board = Board(LEASE)
    board.open(training[:1], nothing)
    for life in range(6):
        assert leased(board, f"w{life}") == training[0], "whole: in parts it would begin anew"
        board.reached(f"w{life}", training[0].label, 1000 * (life + 1))
        board.reached(f"w{life}", "another job", 10**9)
        kill(board, f"w{life}")
    leased(board, "w6")
    board.reached("w6", training[0].label, 6000)  # no further than before
    kill(board, "w6")
    assert len(leased(board, "w7").variations) == 1


# Leases.


def test_every_job_is_leased_once_and_then_there_is_nothing(board, jobs):
    assert [leased(board, f"w{i}") for i in range(4)] == [*jobs, None]
    assert not board.done(*PHASE)
    for job in jobs:
        finish(board, job)
    assert board.done(*PHASE) and board.progress(*PHASE) == (36, 36)


def test_an_expired_lease_goes_out_again_and_a_live_one_does_not(board, jobs):
    for worker in "abc":
        leased(board, worker)
    assert leased(board, "d", LEASE - 0.01) is None
    assert leased(board, "d", LEASE) == jobs[0]
    assert leased(board, "e", LEASE) == jobs[1]
    assert board.leases(*PHASE) == 5


def test_a_trajectory_extends_the_lease_of_its_job(board, jobs):
    for worker in "abc":
        leased(board, worker)
    board.received(next(iter(jobs[0].identities())), 5.0)
    assert leased(board, "d", LEASE + 1) == jobs[1]
    assert leased(board, "e", LEASE + 4.9) == jobs[2]
    assert leased(board, "f", LEASE + 4.9) is None
    assert leased(board, "f", LEASE + 5.0) == jobs[0]


def test_a_repeated_trajectory_extends_the_lease_too_but_measures_nothing(board, jobs):
    first, second = list(jobs[0].identities())[:2]
    leased(board, "a")
    board.received(first, 0.5)
    kill(board, "a", 1.0)
    leased(board, "b", 1.0)
    board.repeated(first, 9.0)
    board.received(second, 9.1)
    board.repeated(Identity("adapt", 9, 0, 0, 0), 9.1)
    assert board.lease("c", 9.1).deadline_s == pytest.approx(4 * 0.5)


def test_the_job_of_a_lost_worker_is_free_at_once(board, jobs):
    for worker in "abc":
        leased(board, worker)
    assert kill(board, "b") == [jobs[1]]
    assert kill(board, "b") == []
    assert leased(board, "d", 0.1) == jobs[1]


def test_a_worker_that_asks_again_gets_back_what_it_held(board, jobs):
    assert leased(board, "a") == jobs[0]
    assert leased(board, "a", 0.1) == jobs[0]


def test_a_finished_job_is_not_leased_again(board, jobs):
    leased(board, "a")
    finish(board, jobs[0])
    assert kill(board, "a") == []
    assert leased(board, "b", 2 * LEASE) == jobs[1]


def test_what_is_stored_already_is_not_asked_for(jobs):
    board = Board(LEASE)
    some = list(jobs[2].identities())[:2]
    board.open(jobs, lambda job: some if job == jobs[2] else set(job.identities()))
    assert board.progress(*PHASE) == (26, 36)
    assert leased(board, "a") == jobs[2]
    assert leased(board, "b") is None
    assert board.wants(some[0]) is None
    finish(board, jobs[2])
    assert board.done(*PHASE) and board.progress(*PHASE) == (36, 36)


def test_duplicates_and_strangers_count_for_nothing(board, jobs):
    identity = next(iter(jobs[0].identities()))
    strangers = [Identity("adapt", 9, 9, 9, 9), *(identity._replace(**{name: 9}) for name in ("task", "variation", "trial"))]
    for one in (identity, identity, *strangers):
        board.received(one, 0.0)
    assert board.progress(*PHASE) == (1, 36)
    assert [board.wants(one) for one in (identity, *strangers)] == [None] * 5
    assert board.wants(identity._replace(trial=1)) == jobs[0]


# Phases.


@pytest.fixture
def later(jobs):
    return [dataclasses.replace(job, kind="adapt", stage="adapt", round=1, policy_version=1) for job in jobs]


def test_phases_are_open_together_and_the_first_goes_first(board, jobs, later):
    board.open(later, nothing)
    assert [leased(board, f"w{i}") for i in range(7)] == [*jobs, *later, None]
    finish(board, later[0])
    assert (board.progress("adapt", 1), board.progress(*PHASE)) == ((12, 36), (0, 36))
    for job in jobs:
        finish(board, job)
    assert board.done(*PHASE) and not board.done("adapt", 1)
    assert (board.leases(*PHASE), board.leases("adapt", 1)) == (3, 3)


def test_a_closed_phase_wants_nothing_and_blames_nobody(board, jobs, later):
    leased(board, "a")
    board.open(later, nothing)
    board.close(*PHASE)
    identity = next(iter(jobs[0].identities()))
    assert board.wants(identity) is None
    board.received(identity, 1.0)
    board.failed("a", jobs[0].name, "raised")
    assert kill(board, "a") == []
    board.back("a")
    assert (board.progress(*PHASE), board.done(*PHASE), board.leases(*PHASE)) == ((0, 0), True, 0)
    assert leased(board, "b") == later[0]


def test_a_phase_opened_again_begins_anew(board, jobs):
    leased(board, "a")
    finish(board, jobs[1])
    board.open(jobs, nothing)
    assert board.progress(*PHASE) == (0, 36)
    assert kill(board, "a") == []
    assert [leased(board, w) for w in "bcd"] == list(jobs)


def test_jobs_of_two_phases_at_once_are_refused(board, jobs, later):
    with pytest.raises(ValueError, match="jobs of 2 phases"):
        board.open([jobs[0], later[0]], nothing)


# Weights.


def test_a_job_acts_with_the_weights_of_its_first_lease_ever_after(board, later):
    board.close(*PHASE)
    board.open(later, nothing)
    newest = {"version": 3}

    def acting(job):
        return newest["version"]

    assert leased(board, "a", acting=acting).policy_version == 3
    newest["version"] = 4
    assert leased(board, "b", acting=acting).policy_version == 4
    kill(board, "a")
    again = leased(board, "c", acting=acting)
    assert (again.task, again.policy_version) == (later[0].task, 3)
    assert board.wants(next(iter(later[0].identities()))).policy_version == 3
    kill(board, "c")
    board.lease("d", 0.0, acting)
    parts = [leased(board, f"p{i}", acting=acting) for i in range(6)]
    assert {part.policy_version for part in parts if part.task in (later[0].task, later[0].task + 1)} == {3}


# Deadlines.


def test_the_deadline_is_a_multiple_of_the_longest_gap_measured(board, jobs, later):
    identities = list(jobs[0].identities())
    assert board.lease("a", 100.0).deadline_s == LEASE
    board.received(identities[0], 100.6)
    board.received(identities[1], 100.7)
    assert board.lease("b", 101.0).deadline_s == pytest.approx(4 * 0.6)
    board.received(identities[2], 102.2)
    assert board.lease("c", 103.0).deadline_s == pytest.approx(4 * 1.5)
    board.open(later, nothing)
    assert board.lease("d", 103.0).deadline_s == LEASE, "nothing has been measured of that kind"


def test_the_deadline_keeps_to_its_bounds(jobs):
    for gap, expected in ((0.001, 1.0), (9.0, LEASE)):
        board = Board(LEASE, floor_s=1.0, factor=4.0)
        board.open(jobs, nothing)
        board.lease("a", 0.0)
        board.received(next(iter(jobs[0].identities())), gap)
        assert board.lease("b", gap).deadline_s == expected


def test_a_trajectory_that_nobody_has_a_lease_for_measures_nothing(board, jobs):
    identities = iter(jobs[0].identities())
    leased(board, "a")
    board.received(next(identities), 0.5)
    kill(board, "a", 1.0)
    board.received(next(identities), 9.0)
    assert board.lease("b", 9.0).deadline_s == pytest.approx(4 * 0.5 * 2), "its job has come back once"


def test_the_deadline_doubles_each_time_that_the_job_comes_back(board, jobs):
    now = 0.0
    for expected in (LEASE, 2 * LEASE, 4 * LEASE):
        lease = board.lease(f"w{now}", now)
        assert (lease.job, lease.deadline_s) == (jobs[0], expected)
        now += expected
    kill(board, "w0.0", now)
    assert board.lease("z", now).deadline_s == 16 * LEASE
    assert board.lease("y", now).deadline_s == LEASE, "only that job's"


# Blame.


def test_a_job_whose_worker_died_once_goes_out_whole(board, jobs):
    leased(board, "a")
    kill(board, "a")
    assert leased(board, "b") == jobs[0]


def test_a_job_whose_worker_died_twice_goes_out_in_parts_of_what_is_missing_behind_the_others(board, jobs):
    stored = [i for i in jobs[0].identities() if i.variation == 1 or (i.task, i.trial) == (0, 0)]
    for worker in ("x", "y"):
        leased(board, worker)
        kill(board, worker)
    for identity in stored:
        board.received(identity, 0.0)
    first = leased(board, "a")
    assert (first.task, first.first, first.variations) == (0, 0, jobs[0].variations[:1])
    order = [leased(board, f"w{i}") for i in range(6)]
    assert order[:2] == list(jobs[1:]) and order[5] is None
    parts = [first, *order[2:5]]
    assert [(p.task, p.first, p.tasks, len(p.variations), p.trials) for p in parts] == [
        (t, v, 1, 1, 2) for t, v in ((0, 0), (0, 2), (1, 0), (1, 2))
    ]
    assert board.wants(Identity("pretrain", 0, 1, 2, 1)) == parts[3]
    for part in parts:
        assert all(jobs[0].variation(i) == part.variation(i) for i in part.identities())
        finish(board, part)
    for job in jobs[1:]:
        finish(board, job)
    assert board.done(*PHASE) and board.progress(*PHASE) == (36, 36)


def test_a_variation_that_ends_its_third_worker_is_quarantined_and_the_others_finish(board, jobs):
    split_first(board)
    culprit = leased(board, "a")
    board.received(next(iter(culprit.identities())), 0.0)
    assert kill(board, "a", cause="worker a died") == []
    assert board.quarantined == {("pretrain", 0, 0, 0): "worker a died"}
    assert board.wants(Identity("pretrain", 0, 0, 0, 1)) is None
    assert board.progress(*PHASE) == (1, 35)
    while (job := leased(board, "b")) is not None:
        finish(board, job)
    assert board.done(*PHASE) and board.progress(*PHASE) == (35, 35)
    assert board.blamed(*PHASE) == board.blamed() == [("pretrain/0/0/0", "worker a died")]
    assert board.blamed("adapt", 0) == []
    board.close(*PHASE)
    assert board.blamed(*PHASE) == [("pretrain/0/0/0", "worker a died")]


def test_an_innocent_part_that_finishes_is_not_blamed(board, jobs):
    split_first(board)
    part = leased(board, "a")
    finish(board, part)
    assert kill(board, "a") == [] and board.blamed() == []


def test_a_job_of_one_variation_is_quarantined_at_its_third_death(jobs):
    alone = dataclasses.replace(jobs[0], variations=jobs[0].variations[:1], tasks=1)
    board = Board(LEASE)
    board.open([alone], nothing)
    for worker in "ab":
        assert leased(board, worker) == alone
        assert kill(board, worker) == [alone] and not board.quarantined
    assert leased(board, "c") == alone
    assert kill(board, "c") == []
    assert board.blamed() == [("pretrain/0/0/0", "it died")] and board.done(*PHASE)
    assert board.progress(*PHASE) == (0, 0)


def test_raising_counts_as_dying_does_and_its_words_are_the_cause(jobs):
    alone = dataclasses.replace(jobs[0], variations=jobs[0].variations[:1], tasks=1)
    board = Board(LEASE)
    board.open([alone], nothing)
    for _ in range(3):
        assert not board.quarantined
        leased(board, "a")
        board.failed("a", ("pretrain", 0, 0, 2), "of a job that it does not hold")
        board.failed("b", alone.name, "of a worker that holds nothing")
        board.failed("a", alone.name, "ValueError: no")
        board.failed("a", alone.name, "said twice")
    assert board.blamed() == [("pretrain/0/0/0", "ValueError: no")]


def test_a_death_counts_against_a_job_whose_lease_had_run_out(board, jobs):
    leased(board, "stuck")
    assert leased(board, "other", LEASE) == jobs[0]
    assert kill(board, "stuck", LEASE) == [], "the other is at work on it"
    kill(board, "other", LEASE)
    assert len(leased(board, "a", LEASE).variations) == 1


def test_a_job_is_not_split_under_the_hands_of_whoever_has_it(board, jobs):
    leased(board, "a")
    assert leased(board, "b", LEASE) == jobs[0]
    kill(board, "a", LEASE)
    assert leased(board, "c", 3 * LEASE) == jobs[0]
    kill(board, "b", 3 * LEASE)
    finish(board, jobs[0], 3 * LEASE)
    assert board.progress(*PHASE) == (12, 36) and leased(board, "d", 3 * LEASE) == jobs[1]


def test_a_worker_that_comes_back_was_not_dead_and_still_holds_its_job(board, jobs):
    for _ in range(5):
        leased(board, "a")
        assert kill(board, "a") == [jobs[0]]
        board.back("a")
        assert leased(board, "b", 0.1) == jobs[1], "a is at work on the first"
        board.lost("b", 0.1)
        board.back("b")
    kill(board, "a")
    assert leased(board, "c") == jobs[0], "whole: that was its first death"


def test_asking_is_coming_back(board, jobs):
    for _ in range(5):
        assert leased(board, "a") == jobs[0]
        kill(board, "a")
    assert leased(board, "b") == jobs[0], "whole: all deaths but the last were taken back"
    board.back("a")
    board.back("a")
    kill(board, "b")
    assert leased(board, "c") == jobs[0], "and the last one too"


def test_a_death_that_was_taken_back_can_come_again(board, jobs):
    leased(board, "a")
    kill(board, "a")
    board.back("a")
    assert kill(board, "a") == [jobs[0]]
    leased(board, "b")
    kill(board, "b")
    assert len(leased(board, "c").variations) == 1


def test_a_worker_that_went_with_its_machine_blames_nobody(board, jobs):
    for worker in "abc":
        assert leased(board, worker) == jobs[0]
        assert kill(board, worker) == [jobs[0]]
        board.excuse(worker)
        board.excuse(worker)
    board.excuse("d")  # the fleet may know it first
    assert leased(board, "d") == jobs[0] and kill(board, "d") == [jobs[0]]
    board.excuse("stranger")
    assert board.lease("e", 0.0).deadline_s == LEASE, "nor is its next lease longer"


def test_the_loss_of_a_machine_is_taken_back_from_the_parts_of_a_job_too(board, jobs):
    split_first(board)
    part = leased(board, "a")
    board.excuse("x")
    assert kill(board, "a") == [part], "its second death"
    for name in ("b", "c"):
        finish(board, leased(board, name))
    while (again := leased(board, "d")) != part:
        finish(board, again)
    kill(board, "d")
    assert list(board.quarantined) == [part.name]


def test_a_variation_given_up_for_losses_of_machines_is_tried_again(board, jobs):
    split_first(board)
    part = leased(board, "a")
    board.received(next(iter(part.identities())), 0.0)
    kill(board, "a")
    assert list(board.quarantined) == [part.name] and board.progress(*PHASE) == (1, 35)
    board.excuse("a")
    assert not board.quarantined and board.progress(*PHASE) == (1, 36) and not board.done(*PHASE)
    assert board.wants(list(part.identities())[1]) == part
    while (job := leased(board, "b")) is not None:
        finish(board, job)
    assert board.done(*PHASE)


def test_a_quarantine_of_a_phase_that_is_over_stays(board, jobs):
    split_first(board)
    part = leased(board, "a")
    kill(board, "a")
    board.close(*PHASE)
    board.excuse("a")
    assert list(board.quarantined) == [part.name]
    board.open(jobs, nothing)
    board.excuse("x")
    assert leased(board, "b") == jobs[0]


def test_blame_is_listed_in_canonical_order(jobs, later):
    board = Board(LEASE)
    one = [
        dataclasses.replace(jobs[0], task=t, variations=jobs[0].variations[:1], tasks=1, first=v)
        for t in (10, 9)
        for v in (2, 1)
    ]
    board.open([dataclasses.replace(job, stage="adapt") for job in one], nothing)
    board.open(one, nothing)
    while (job := leased(board, "a")) is not None:
        board.failed("a", job.name, "no")
    names = [name for name, _ in board.blamed()]
    assert names == [f"{s}/0/{t}/{v}" for s in ("pretrain", "adapt") for t in (9, 10) for v in (1, 2)]
    assert [name for name, _ in board.blamed("adapt")] == names[4:]
    board.open(one, nothing)
    assert [name for name, _ in board.blamed()] == names[4:], "a phase that begins anew blames nobody yet"


# Anything at all.

EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["lease", "lease", "lease", "store", "store", "die", "die", "fail", "back", "excuse", "wait"]),
        st.integers(0, 3),
        st.integers(0, 35),
    ),
    max_size=120,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=EVENTS)
def test_whatever_happens_nothing_is_lost_and_nobody_is_blamed_for_less_than_three(jobs, events):
    board = Board(LEASE, floor_s=1.0, factor=4.0)
    board.open(jobs, nothing)
    everything = [i for job in jobs for i in job.identities()]
    stored, held, lost, excused, now = set(), {}, {}, set(), 0.0
    accused = collections.Counter()
    ends = {}

    def accuse(job, by):
        accused.update({i[:4]: by for i in job.identities()})

    def check():
        given_up = set(board.quarantined)
        missing = [i for i in everything if i not in stored]
        wanted = [i for i in everything if board.wants(i) is not None]
        assert wanted == [i for i in missing if i[:4] not in given_up]
        assert board.progress(*PHASE) == (len(stored), 36 - sum(i[:4] in given_up for i in missing))
        assert board.done(*PHASE) == (not wanted)
        assert all(accused[key] >= 3 for key in given_up)
        assert all(
            board.wants(i).variation(i) == next(j for j in jobs if i in set(j.identities())).variation(i) for i in wanted[:3]
        )

    for what, who, which in events:
        worker = f"w{who}"
        if what == "lease":
            if (death := lost.pop(worker, None)) is not None:
                accuse(death, -1)
            held.pop(worker, None)
            lease = board.lease(worker, now)
            assert lease or not any(board.wants(i) for i in everything) or held
            if lease:
                same = [
                    w
                    for w, other in held.items()
                    if other.name == lease.job.name and len(other.variations) == len(lease.job.variations)
                ]
                assert all(now >= ends[w] for w in same), "nobody's job is taken away in time"
                held[worker], ends[worker] = lease.job, now + lease.deadline_s
        elif what == "store":
            identity = everything[which]
            job = board.wants(identity)
            board.received(identity, now)
            if job is not None:
                stored.add(identity)
                ends.update(dict.fromkeys(held, 0.0))  # their time runs anew; the tests above look at that
        elif what == "die" and worker in held:
            gone = held.pop(worker)
            if worker not in excused:
                lost[worker] = gone
                accuse(gone, 1)
            board.lost(worker, now)
        elif what == "fail" and worker in held:
            accuse(held[worker], 1)
            board.failed(worker, held[worker].name, "no")
            del held[worker]
        elif what == "back" and worker in lost:
            held[worker] = lost.pop(worker)
            ends[worker] = 0.0
            accuse(held[worker], -1)
            board.back(worker)
        elif what == "excuse" and which % 3 == 0:
            excused.add(worker)
            board.excuse(worker)
            if (death := lost.pop(worker, None)) is not None:
                accuse(death, -1)
        elif what == "wait":
            now += which / 5
        check()
    for _ in range(100):
        lease = board.lease("honest", now)
        if lease is not None:
            for identity in lease.job.identities():
                if board.wants(identity) is not None:
                    stored.add(identity)
                board.received(identity, now)
        now += 1000 * LEASE
        check()
        if board.done(*PHASE):
            return
    raise AssertionError("an honest worker does not come to an end")
