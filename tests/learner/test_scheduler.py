"""The LeaseScheduler with a fake clock: what is leased, to whom, what comes back, and who is to blame."""

import collections
import dataclasses

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from icrl_dist.methods.recipes import METHODS
from icrl_dist.types import Identity
from learner.scheduler import LeaseScheduler

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
def scheduler(jobs):
    made = LeaseScheduler(LEASE, floor_s=1.0, factor=4.0)
    made.open(jobs, nothing)
    return made


def leased(scheduler, worker, now=0.0, acting=None):
    lease = scheduler.lease(worker, now, acting)
    return lease.job if lease else None


def finish(scheduler, job, now=0.0):
    for identity in job.identities():
        scheduler.received(identity, now)


def kill(scheduler, worker, now=0.0, cause="it died"):
    return scheduler.worker_lost(worker, now, cause)


def split_first(scheduler):
    """The first job's worker dies twice; its parts are behind the other two jobs."""
    for worker in ("x", "y"):
        leased(scheduler, worker)
        kill(scheduler, worker)


# Jobs that take long before their first trajectory.


@pytest.fixture
def training(jobs):
    return [dataclasses.replace(job, kind="train_expert") for job in jobs]


def test_what_comes_from_a_cache_at_once_shortens_no_training_of_experts(training):
    scheduler = LeaseScheduler(LEASE, floor_s=0.1, factor=2.0)
    scheduler.open(training, nothing)
    scheduler.lease("a", 0.0)
    finish(scheduler, training[0], 0.01)
    assert scheduler.lease("a", 0.02).deadline_s == LEASE


def test_a_training_that_gets_further_in_every_life_is_not_to_blame_for_their_ends(training):
    scheduler = LeaseScheduler(LEASE)
    scheduler.open(training[:1], nothing)
    for life in range(6):
        assert leased(scheduler, f"w{life}") == training[0], "whole: in parts it would begin anew"
        scheduler.reached(f"w{life}", training[0].label, 1000 * (life + 1))
        scheduler.reached(f"w{life}", "another job", 10**9)
        kill(scheduler, f"w{life}")
    leased(scheduler, "w6")
    scheduler.reached("w6", training[0].label, 6000)  # no further than before
    kill(scheduler, "w6")
    assert len(leased(scheduler, "w7").variations) == 1


# Leases.


def test_every_job_is_leased_once_and_then_there_is_nothing(scheduler, jobs):
    assert [leased(scheduler, f"w{i}") for i in range(4)] == [*jobs, None]
    assert not scheduler.done(*PHASE)
    for job in jobs:
        finish(scheduler, job)
    assert scheduler.done(*PHASE) and scheduler.progress(*PHASE) == (36, 36)


def test_an_expired_lease_goes_out_again_and_a_live_one_does_not(scheduler, jobs):
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


def test_a_repeated_trajectory_extends_the_lease_too_but_measures_nothing(scheduler, jobs):
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


def test_a_worker_that_asks_again_gets_back_what_it_held(scheduler, jobs):
    assert leased(scheduler, "a") == jobs[0]
    assert leased(scheduler, "a", 0.1) == jobs[0]


def test_a_finished_job_is_not_leased_again(scheduler, jobs):
    leased(scheduler, "a")
    finish(scheduler, jobs[0])
    assert kill(scheduler, "a") == []
    assert leased(scheduler, "b", 2 * LEASE) == jobs[1]


def test_what_is_stored_already_is_not_asked_for(jobs):
    scheduler = LeaseScheduler(LEASE)
    some = list(jobs[2].identities())[:2]
    scheduler.open(jobs, lambda job: some if job == jobs[2] else set(job.identities()))
    assert scheduler.progress(*PHASE) == (26, 36)
    assert leased(scheduler, "a") == jobs[2]
    assert leased(scheduler, "b") is None
    assert scheduler.pending_job(some[0]) is None
    finish(scheduler, jobs[2])
    assert scheduler.done(*PHASE) and scheduler.progress(*PHASE) == (36, 36)


def test_duplicates_and_strangers_count_for_nothing(scheduler, jobs):
    identity = next(iter(jobs[0].identities()))
    strangers = [Identity("adapt", 9, 9, 9, 9), *(identity._replace(**{name: 9}) for name in ("task", "variation", "trial"))]
    for one in (identity, identity, *strangers):
        scheduler.received(one, 0.0)
    assert scheduler.progress(*PHASE) == (1, 36)
    assert [scheduler.pending_job(one) for one in (identity, *strangers)] == [None] * 5
    assert scheduler.pending_job(identity._replace(trial=1)) == jobs[0]


# Phases.


@pytest.fixture
def later(jobs):
    return [dataclasses.replace(job, kind="adapt", stage="adapt", round=1, policy_version=1) for job in jobs]


def test_phases_are_open_together_and_the_first_goes_first(scheduler, jobs, later):
    scheduler.open(later, nothing)
    assert [leased(scheduler, f"w{i}") for i in range(7)] == [*jobs, *later, None]
    finish(scheduler, later[0])
    assert (scheduler.progress("adapt", 1), scheduler.progress(*PHASE)) == ((12, 36), (0, 36))
    for job in jobs:
        finish(scheduler, job)
    assert scheduler.done(*PHASE) and not scheduler.done("adapt", 1)
    assert (scheduler.leases(*PHASE), scheduler.leases("adapt", 1)) == (3, 3)


def test_a_closed_phase_wants_nothing_and_blames_nobody(scheduler, jobs, later):
    leased(scheduler, "a")
    scheduler.open(later, nothing)
    scheduler.close(*PHASE)
    identity = next(iter(jobs[0].identities()))
    assert scheduler.pending_job(identity) is None
    scheduler.received(identity, 1.0)
    scheduler.job_failed("a", jobs[0].name, "raised")
    assert kill(scheduler, "a") == []
    scheduler.worker_back("a")
    assert (scheduler.progress(*PHASE), scheduler.done(*PHASE), scheduler.leases(*PHASE)) == ((0, 0), True, 0)
    assert leased(scheduler, "b") == later[0]


def test_a_phase_opened_again_begins_anew(scheduler, jobs):
    leased(scheduler, "a")
    finish(scheduler, jobs[1])
    scheduler.open(jobs, nothing)
    assert scheduler.progress(*PHASE) == (0, 36)
    assert kill(scheduler, "a") == []
    assert [leased(scheduler, w) for w in "bcd"] == list(jobs)


def test_jobs_of_two_phases_at_once_are_refused(scheduler, jobs, later):
    with pytest.raises(ValueError, match="jobs of 2 phases"):
        scheduler.open([jobs[0], later[0]], nothing)


# Weights.


def test_a_job_acts_with_the_weights_of_its_first_lease_ever_after(scheduler, later):
    scheduler.close(*PHASE)
    scheduler.open(later, nothing)
    newest = {"version": 3}

    def acting(job):
        return newest["version"]

    assert leased(scheduler, "a", acting=acting).policy_version == 3
    newest["version"] = 4
    assert leased(scheduler, "b", acting=acting).policy_version == 4
    kill(scheduler, "a")
    again = leased(scheduler, "c", acting=acting)
    assert (again.task, again.policy_version) == (later[0].task, 3)
    assert scheduler.pending_job(next(iter(later[0].identities()))).policy_version == 3
    kill(scheduler, "c")
    scheduler.lease("d", 0.0, acting)
    parts = [leased(scheduler, f"p{i}", acting=acting) for i in range(6)]
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
    scheduler.open(later, nothing)
    assert scheduler.lease("d", 103.0).deadline_s == LEASE, "nothing has been measured of that kind"


def test_the_deadline_keeps_to_its_bounds(jobs):
    for gap, expected in ((0.001, 1.0), (9.0, LEASE)):
        scheduler = LeaseScheduler(LEASE, floor_s=1.0, factor=4.0)
        scheduler.open(jobs, nothing)
        scheduler.lease("a", 0.0)
        scheduler.received(next(iter(jobs[0].identities())), gap)
        assert scheduler.lease("b", gap).deadline_s == expected


def test_a_trajectory_that_nobody_has_a_lease_for_measures_nothing(scheduler, jobs):
    identities = iter(jobs[0].identities())
    leased(scheduler, "a")
    scheduler.received(next(identities), 0.5)
    kill(scheduler, "a", 1.0)
    scheduler.received(next(identities), 9.0)
    assert scheduler.lease("b", 9.0).deadline_s == pytest.approx(4 * 0.5 * 2), "its job has come back once"


def test_the_deadline_doubles_each_time_that_the_job_comes_back(scheduler, jobs):
    now = 0.0
    for expected in (LEASE, 2 * LEASE, 4 * LEASE):
        lease = scheduler.lease(f"w{now}", now)
        assert (lease.job, lease.deadline_s) == (jobs[0], expected)
        now += expected
    kill(scheduler, "w0.0", now)
    assert scheduler.lease("z", now).deadline_s == 16 * LEASE
    assert scheduler.lease("y", now).deadline_s == LEASE, "only that job's"


# Blame.


def test_a_job_whose_worker_died_once_goes_out_whole(scheduler, jobs):
    leased(scheduler, "a")
    kill(scheduler, "a")
    assert leased(scheduler, "b") == jobs[0]


def test_a_job_whose_worker_died_twice_goes_out_in_parts_of_what_is_missing_behind_the_others(scheduler, jobs):
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


def test_a_variation_that_ends_its_third_worker_is_quarantined_and_the_others_finish(scheduler, jobs):
    split_first(scheduler)
    culprit = leased(scheduler, "a")
    scheduler.received(next(iter(culprit.identities())), 0.0)
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


def test_an_innocent_part_that_finishes_is_not_blamed(scheduler, jobs):
    split_first(scheduler)
    part = leased(scheduler, "a")
    finish(scheduler, part)
    assert kill(scheduler, "a") == [] and scheduler.quarantine_causes() == []


def test_a_job_of_one_variation_is_quarantined_at_its_third_death(jobs):
    alone = dataclasses.replace(jobs[0], variations=jobs[0].variations[:1], tasks=1)
    scheduler = LeaseScheduler(LEASE)
    scheduler.open([alone], nothing)
    for worker in "ab":
        assert leased(scheduler, worker) == alone
        assert kill(scheduler, worker) == [alone] and not scheduler.quarantined
    assert leased(scheduler, "c") == alone
    assert kill(scheduler, "c") == []
    assert scheduler.quarantine_causes() == [("pretrain/0/0/0", "it died")] and scheduler.done(*PHASE)
    assert scheduler.progress(*PHASE) == (0, 0)


def test_raising_counts_as_dying_does_and_its_words_are_the_cause(jobs):
    alone = dataclasses.replace(jobs[0], variations=jobs[0].variations[:1], tasks=1)
    scheduler = LeaseScheduler(LEASE)
    scheduler.open([alone], nothing)
    for _ in range(3):
        assert not scheduler.quarantined
        leased(scheduler, "a")
        scheduler.job_failed("a", ("pretrain", 0, 0, 2), "of a job that it does not hold")
        scheduler.job_failed("b", alone.name, "of a worker that holds nothing")
        scheduler.job_failed("a", alone.name, "ValueError: no")
        scheduler.job_failed("a", alone.name, "said twice")
    assert scheduler.quarantine_causes() == [("pretrain/0/0/0", "ValueError: no")]


def test_a_death_counts_against_a_job_whose_lease_had_run_out(scheduler, jobs):
    leased(scheduler, "stuck")
    assert leased(scheduler, "other", LEASE) == jobs[0]
    assert kill(scheduler, "stuck", LEASE) == [], "the other is at work on it"
    kill(scheduler, "other", LEASE)
    assert len(leased(scheduler, "a", LEASE).variations) == 1


def test_a_job_is_not_split_under_the_hands_of_whoever_has_it(scheduler, jobs):
    leased(scheduler, "a")
    assert leased(scheduler, "b", LEASE) == jobs[0]
    kill(scheduler, "a", LEASE)
    assert leased(scheduler, "c", 3 * LEASE) == jobs[0]
    kill(scheduler, "b", 3 * LEASE)
    finish(scheduler, jobs[0], 3 * LEASE)
    assert scheduler.progress(*PHASE) == (12, 36) and leased(scheduler, "d", 3 * LEASE) == jobs[1]


def test_a_worker_that_comes_back_was_not_dead_and_still_holds_its_job(scheduler, jobs):
    for _ in range(5):
        leased(scheduler, "a")
        assert kill(scheduler, "a") == [jobs[0]]
        scheduler.worker_back("a")
        assert leased(scheduler, "b", 0.1) == jobs[1], "a is at work on the first"
        scheduler.worker_lost("b", 0.1)
        scheduler.worker_back("b")
    kill(scheduler, "a")
    assert leased(scheduler, "c") == jobs[0], "whole: that was its first death"


def test_asking_is_coming_back(scheduler, jobs):
    for _ in range(5):
        assert leased(scheduler, "a") == jobs[0]
        kill(scheduler, "a")
    assert leased(scheduler, "b") == jobs[0], "whole: all deaths but the last were taken back"
    scheduler.worker_back("a")
    scheduler.worker_back("a")
    kill(scheduler, "b")
    assert leased(scheduler, "c") == jobs[0], "and the last one too"


def test_a_death_that_was_taken_back_can_come_again(scheduler, jobs):
    leased(scheduler, "a")
    kill(scheduler, "a")
    scheduler.worker_back("a")
    assert kill(scheduler, "a") == [jobs[0]]
    leased(scheduler, "b")
    kill(scheduler, "b")
    assert len(leased(scheduler, "c").variations) == 1


def test_a_worker_that_went_with_its_machine_blames_nobody(scheduler, jobs):
    for worker in "abc":
        assert leased(scheduler, worker) == jobs[0]
        assert kill(scheduler, worker) == [jobs[0]]
        scheduler.lost_with_node(worker)
        scheduler.lost_with_node(worker)
    scheduler.lost_with_node("d")  # the fleet may know it first
    assert leased(scheduler, "d") == jobs[0] and kill(scheduler, "d") == [jobs[0]]
    scheduler.lost_with_node("stranger")
    assert scheduler.lease("e", 0.0).deadline_s == LEASE, "nor is its next lease longer"


def test_the_loss_of_a_machine_is_taken_back_from_the_parts_of_a_job_too(scheduler, jobs):
    split_first(scheduler)
    part = leased(scheduler, "a")
    scheduler.lost_with_node("x")
    assert kill(scheduler, "a") == [part], "its second death"
    for name in ("b", "c"):
        finish(scheduler, leased(scheduler, name))
    while (again := leased(scheduler, "d")) != part:
        finish(scheduler, again)
    kill(scheduler, "d")
    assert list(scheduler.quarantined) == [part.name]


def test_a_variation_given_up_for_losses_of_machines_is_tried_again(scheduler, jobs):
    split_first(scheduler)
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


def test_a_quarantine_of_a_phase_that_is_over_stays(scheduler, jobs):
    split_first(scheduler)
    part = leased(scheduler, "a")
    kill(scheduler, "a")
    scheduler.close(*PHASE)
    scheduler.lost_with_node("a")
    assert list(scheduler.quarantined) == [part.name]
    scheduler.open(jobs, nothing)
    scheduler.lost_with_node("x")
    assert leased(scheduler, "b") == jobs[0]


def test_blame_is_listed_in_canonical_order(jobs, later):
    scheduler = LeaseScheduler(LEASE)
    one = [
        dataclasses.replace(jobs[0], task=t, variations=jobs[0].variations[:1], tasks=1, first=v)
        for t in (10, 9)
        for v in (2, 1)
    ]
    scheduler.open([dataclasses.replace(job, stage="adapt") for job in one], nothing)
    scheduler.open(one, nothing)
    while (job := leased(scheduler, "a")) is not None:
        scheduler.job_failed("a", job.name, "no")
    names = [name for name, _ in scheduler.quarantine_causes()]
    assert names == [f"{s}/0/{t}/{v}" for s in ("pretrain", "adapt") for t in (9, 10) for v in (1, 2)]
    assert [name for name, _ in scheduler.quarantine_causes("adapt")] == names[4:]
    scheduler.open(one, nothing)
    assert [name for name, _ in scheduler.quarantine_causes()] == names[4:], "a phase that begins anew blames nobody yet"


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
    scheduler = LeaseScheduler(LEASE, floor_s=1.0, factor=4.0)
    scheduler.open(jobs, nothing)
    everything = [i for job in jobs for i in job.identities()]
    stored, held, lost, excused, now = set(), {}, {}, set(), 0.0
    accused = collections.Counter()
    ends = {}

    def accuse(job, by):
        accused.update({i[:4]: by for i in job.identities()})

    def check():
        given_up = set(scheduler.quarantined)
        missing = [i for i in everything if i not in stored]
        wanted = [i for i in everything if scheduler.pending_job(i) is not None]
        assert wanted == [i for i in missing if i[:4] not in given_up]
        assert scheduler.progress(*PHASE) == (len(stored), 36 - sum(i[:4] in given_up for i in missing))
        assert scheduler.done(*PHASE) == (not wanted)
        assert all(accused[key] >= 3 for key in given_up)
        assert all(
            scheduler.pending_job(i).variation(i) == next(j for j in jobs if i in set(j.identities())).variation(i)
            for i in wanted[:3]
        )

    for what, who, which in events:
        worker = f"w{who}"
        if what == "lease":
            if (death := lost.pop(worker, None)) is not None:
                accuse(death, -1)
            held.pop(worker, None)
            lease = scheduler.lease(worker, now)
            assert lease or not any(scheduler.pending_job(i) for i in everything) or held
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
            job = scheduler.pending_job(identity)
            scheduler.received(identity, now)
            if job is not None:
                stored.add(identity)
                ends.update(dict.fromkeys(held, 0.0))  # their time runs anew; the tests above look at that
        elif what == "die" and worker in held:
            gone = held.pop(worker)
            if worker not in excused:
                lost[worker] = gone
                accuse(gone, 1)
            scheduler.worker_lost(worker, now)
        elif what == "fail" and worker in held:
            accuse(held[worker], 1)
            scheduler.job_failed(worker, held[worker].name, "no")
            del held[worker]
        elif what == "back" and worker in lost:
            held[worker] = lost.pop(worker)
            ends[worker] = 0.0
            accuse(held[worker], -1)
            scheduler.worker_back(worker)
        elif what == "excuse" and which % 3 == 0:
            excused.add(worker)
            scheduler.lost_with_node(worker)
            if (death := lost.pop(worker, None)) is not None:
                accuse(death, -1)
        elif what == "wait":
            now += which / 5
        check()
    for _ in range(100):
        lease = scheduler.lease("honest", now)
        if lease is not None:
            for identity in lease.job.identities():
                if scheduler.pending_job(identity) is not None:
                    stored.add(identity)
                scheduler.received(identity, now)
        now += 1000 * LEASE
        check()
        if scheduler.done(*PHASE):
            return
    raise AssertionError("an honest worker does not come to an end")
