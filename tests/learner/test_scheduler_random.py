"""The scheduler under random sequences of events."""

import collections

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from icrl_dist.interfaces import VariationKey
from icrl_dist.types import Identity, Job
from learner.scheduler import LeaseScheduler
from tests.learner.scheduling import LEASE, PHASE, jobs, nothing_stored
from tests.optional import known

__all__ = ["jobs"]


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["lease", "lease", "lease", "store", "store", "die", "die", "fail", "back", "node lost", "wait"]),
        st.integers(0, 3),
        st.integers(0, 35),
    ),
    max_size=120,
)


SPLIT_AFTER_A_DISCONNECTION = (
    *(("lease", 0), ("fail", 0), ("lease", 0), ("die", 0)),
    *(("lease", 1), ("lease", 0), ("die", 1)),
)
"""A worker counts as dead, its job is split because of that, and the worker asks for the next job."""


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=EVENTS)
@example([(what, who, 0) for what, who in SPLIT_AFTER_A_DISCONNECTION])
def test_no_sequence_of_events_loses_a_trajectory_or_quarantines_before_three_failures(jobs, events):
    scheduler = LeaseScheduler(LEASE, floor_s=1.0, factor=4.0)
    scheduler.open(jobs, nothing_stored)
    everything = [i for job in jobs for i in job.identities()]
    stored, held, lost, lost_nodes, now = set[Identity](), dict[str, Job](), dict[str, Job](), set[str](), 0.0
    failures = collections.Counter[VariationKey]()
    ends = dict[str, float]()

    def count_failure(job, by):
        failures.update({i[:4]: by for i in job.identities()})

    def check():
        quarantined = set(scheduler.quarantined)
        missing = [i for i in everything if i not in stored]
        wanted = [i for i in everything if scheduler.pending_job(i) is not None]
        assert wanted == [i for i in missing if i[:4] not in quarantined]
        assert scheduler.progress(*PHASE) == (len(stored), 36 - sum(i[:4] in quarantined for i in missing))
        assert scheduler.done(*PHASE) == (not wanted)
        assert all(failures[key] >= 3 for key in quarantined)
        assert all(
            known(scheduler.pending_job(i)).variation(i) == next(j for j in jobs if i in set(j.identities())).variation(i)
            for i in wanted[:3]
        )

    for what, who, which in events:
        worker = f"w{who}"
        if what == "lease":
            if (death := lost.pop(worker, None)) is not None:
                count_failure(death, -1)
            held.pop(worker, None)
            lease = scheduler.lease(worker, now)
            assert lease or not any(scheduler.pending_job(i) for i in everything) or held
            if lease:
                same = [
                    w
                    for w, other in held.items()
                    if other.name == lease.job.name and len(other.variations) == len(lease.job.variations)
                ]
                assert all(now >= ends[w] for w in same), "no job is leased again before its lease expires"
                held[worker], ends[worker] = lease.job, now + lease.deadline_s
        elif what == "store":
            identity = everything[which]
            job = scheduler.pending_job(identity)
            scheduler.received(identity, now)
            if job is not None:
                stored.add(identity)
                ends.update(dict.fromkeys(held, 0.0))  # leases start again; other tests check when
        elif what == "die" and worker in held:
            lost_job = held.pop(worker)
            if worker not in lost_nodes:
                lost[worker] = lost_job
                count_failure(lost_job, 1)
            scheduler.worker_lost(worker, now)
        elif what == "fail" and worker in held:
            count_failure(held[worker], 1)
            scheduler.job_failed(worker, held[worker].name, "no")
            del held[worker]
        elif what == "back" and worker in lost:
            held[worker] = lost.pop(worker)
            ends[worker] = 0.0
            count_failure(held[worker], -1)
            scheduler.worker_back(worker)
        elif what == "node lost" and which % 3 == 0:
            lost_nodes.add(worker)
            scheduler.lost_with_node(worker)
            if (death := lost.pop(worker, None)) is not None:
                count_failure(death, -1)
        elif what == "wait":
            now += which / 5
        check()
    for _ in range(100):
        lease = scheduler.lease("reliable", now)
        if lease is not None:
            for identity in lease.job.identities():
                if scheduler.pending_job(identity) is not None:
                    stored.add(identity)
                scheduler.received(identity, now)
        now += 1000 * LEASE
        check()
        if scheduler.done(*PHASE):
            return
    raise AssertionError("a worker without failures does not finish the phase")
