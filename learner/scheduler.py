"""Lease scheduler: which jobs the open phases still need, which worker holds each, and which variations fail.

A pure state machine; the time is an argument.  It leases only jobs of open phases: otherwise a fast
worker would do jobs of later phases with stale weights.

A job whose worker died is first leased again as a whole, and only after a second death in parts of one
variation each.  The batch shape of a job is part of its floating-point result, so a worker killed from
outside must not change the digests of the run.  The parts show which variation fails; the others finish.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field

from icrl_dist.types import STAGES, Identity, Job

MAX_FAILURES = 3
"""A variation is quarantined after this many deaths of its workers or exceptions, counted together."""

_MAX_DOUBLINGS = 10


@dataclass(frozen=True)
class Lease:
    """A job for a worker, and the seconds within which each next trajectory must arrive."""

    job: Job
    deadline_s: float


@dataclass(slots=True, eq=False)
class _JobState:
    job: Job
    missing: set[int]
    """Numbers (by row and trial) of the trajectories that are not stored yet; empty: the job is done."""
    worker: str = ""
    since: float = 0.0
    allowed: float = 0.0
    expired: int = 0
    failures: int = 0
    progress: int = 0
    """Progress that the present holder of the lease has reported, and the largest of earlier holders."""
    earlier_progress: int = 0
    version_fixed: bool = False
    quarantined: set[int] = field(default_factory=set)
    """Numbers of the trajectories that were missing when the variation was quarantined."""
    parts: list[_JobState] = field(default_factory=list)

    def number(self, identity: Identity) -> int:
        """Number of a trajectory of the job's variations within the job; -1 for a trial that the job does not have."""
        job = self.job
        if identity.trial >= job.trials:
            return -1
        row = (identity.task - job.task) * (len(job.variations) // job.tasks) + identity.variation - job.first
        return row * job.trials + identity.trial

    def unfinished_parts(self) -> Iterator[_JobState]:
        """One state per variation with missing trajectories."""
        trials = self.job.trials
        for row, (task, variation) in enumerate(self.job.rows()):
            missing = {n - row * trials for n in self.missing if n // trials == row}
            if missing:
                one = (self.job.variations[row],)
                job = dataclasses.replace(self.job, task=task, variations=one, tasks=1, first=variation)
                yield _JobState(job, missing, expired=self.expired, failures=MAX_FAILURES - 1, version_fixed=self.version_fixed)


@dataclass(slots=True)
class _PhaseState:
    unfinished: dict[tuple[str, int, int, int], _JobState]
    """Unfinished jobs by name, in the order in which they are leased."""
    state_of: dict[tuple[int, int], _JobState] = field(default_factory=dict)
    """The state of the job that contains each (task, variation)."""
    expected: int = 0
    arrived: int = 0
    leases: int = 0

    def add(self, state: _JobState) -> None:
        self.unfinished[state.job.name] = state
        self.state_of.update(dict.fromkeys(state.job.rows(), state))


class LeaseScheduler:
    """Leases the jobs of the open phases to workers; a job is done when all its trajectories are stored."""

    def __init__(self, lease_s: float, floor_s: float = 5.0, factor: float = 10.0) -> None:
        """A lease expires ``factor`` times the longest measured gap after the job's last trajectory.

        The time is at least ``floor_s`` and at most ``lease_s`` seconds; without a measurement it is
        ``lease_s``.  It doubles for a job each time that the job comes back unfinished.
        """
        self._lease_s, self._floor_s, self._factor = lease_s, floor_s, factor
        self._phases: dict[tuple[str, int], _PhaseState] = {}
        self._held: dict[str, _JobState] = {}
        self._deaths: dict[str, _JobState] = {}
        self._lost_with_node: set[str] = set()
        self._longest_gap: dict[str, float] = {}
        self.quarantined: dict[tuple[str, int, int, int], str] = {}
        """Cause of each quarantine, by (stage, round, task, variation)."""

    def open(self, jobs: Sequence[Job], have: Callable[[Job], Collection[Identity]]) -> None:
        """Open a phase, or open it again from the start; phases that are open stay open.

        ``have`` returns the identities of a job that are stored; these are not collected again.
        Raises ValueError if the jobs belong to several phases.
        """
        names = {(job.stage, job.round) for job in jobs}
        if len(names) > 1:
            raise ValueError(f"jobs of {len(names)} phases, {sorted(names)}: open one phase at a time")
        for name in names:
            self.close(*name)
            phase = self._phases[name] = _PhaseState({})
            self.quarantined = {key: cause for key, cause in self.quarantined.items() if key[:2] != name}
            for job in jobs:
                state = _JobState(job, set(range(len(job.variations) * job.trials)))
                state.missing.difference_update([state.number(i) for i in have(job)])
                phase.add(state)
                phase.expected += len(job.variations) * job.trials
                phase.arrived += len(job.variations) * job.trials - len(state.missing)
                if not state.missing:
                    del phase.unfinished[job.name]

    def close(self, stage: str, round: int) -> None:
        """Forget the open jobs of a phase; its quarantined variations stay in ``quarantined``."""
        self._phases.pop((stage, round), None)

    def progress(self, stage: str, round: int) -> tuple[int, int]:
        """Numbers of trajectories stored and expected; quarantined ones are not expected."""
        phase = self._phases.get((stage, round))
        return (phase.arrived, phase.expected) if phase else (0, 0)

    def done(self, stage: str, round: int) -> bool:
        """Whether no trajectory of this phase is missing."""
        phase = self._phases.get((stage, round))
        return phase is None or not phase.unfinished

    def leases(self, stage: str, round: int) -> int:
        """Number of leases granted in a phase, repeated ones included."""
        phase = self._phases.get((stage, round))
        return phase.leases if phase else 0

    def quarantine_causes(self, stage: str | None = None, round: int | None = None) -> list[tuple[str, str]]:
        """(name, cause) of the quarantined variations of one phase, or of all: ``adapt/0/3/1``, in canonical order."""
        found = sorted(self.quarantined.items(), key=lambda item: (STAGES.index(item[0][0]), *item[0][1:]))
        return [("/".join(map(str, key)), cause) for key, cause in found if stage in (None, key[0]) and round in (None, key[1])]

    def lease(self, worker: str, now: float, policy_version: Callable[[Job], int] | None = None) -> Lease | None:
        """Lease the first job that is free or whose lease has expired; None if there is none now.

        A worker asks only while it holds no job, so a job that it held before is released first.
        ``policy_version`` returns the version for a job that is leased for the first time; the job
        keeps that version, so that a worker that repeats it acts with the same T^j.
        """
        self.worker_back(worker)
        self._release(worker)
        found = next(
            (
                (phase, state)
                for phase in self._phases.values()
                for state in phase.unfinished.values()
                if not state.worker or now >= state.since + state.allowed
            ),
            None,
        )
        if found is None:
            return None
        phase, state = found
        state.expired += bool(state.worker)
        if state.failures >= MAX_FAILURES - 1 and len(state.job.variations) > 1:
            state = self._split(phase, state)
        if policy_version is not None and not state.version_fixed:
            state.job = dataclasses.replace(state.job, policy_version=policy_version(state.job))
        state.version_fixed = True
        state.worker, state.since, state.allowed = worker, now, self._allowed(state)
        state.progress, state.earlier_progress = 0, max(state.earlier_progress, state.progress)
        self._held[worker] = state
        phase.leases += 1
        return Lease(state.job, state.allowed)

    def pending_job(self, identity: Identity) -> Job | None:
        """The job in which this trajectory is missing; None if no open job needs it."""
        state = self._state(identity)
        return state.job if state and state.number(identity) in state.missing else None

    def received(self, identity: Identity, now: float) -> None:
        """Record that a trajectory is stored; the lease of its job starts again now."""
        state = self._state(identity)
        if state is None or (number := state.number(identity)) not in state.missing:
            return
        if state.worker:
            gap = now - state.since
            self._longest_gap[state.job.kind] = max(gap, self._longest_gap.get(state.job.kind, 0.0))
        state.since = now
        state.missing.remove(number)
        phase = self._phases[identity.stage, identity.round]
        phase.arrived += 1
        if not state.missing:
            del phase.unfinished[state.job.name]

    def repeated(self, identity: Identity, now: float) -> None:
        """Record that a stored trajectory arrived again; the lease starts again, because a worker repeats the job."""
        state = self._state(identity)
        if state is not None:
            state.since = now

    def reached(self, worker: str, job: str, progress: int) -> None:
        """Record the progress that a worker reports in a job with a long time before its first trajectory."""
        state = self._held.get(worker)
        if state is not None and state.job.label == job:
            state.progress = max(state.progress, progress)

    def worker_lost(self, worker: str, now: float, cause: str = "its worker died") -> list[Job]:
        """Record that a worker is gone: its unfinished job has failed once more and is free; returns it if so.

        The failure counts even if the lease had expired and another worker has the job now.  If the job
        got further than ever before, its earlier failures are forgotten: it continues from a checkpoint,
        and several workers in turn may be killed from outside.
        """
        state = self._held.get(worker)
        if state is None or not self._release(worker):
            return []
        if state.progress > state.earlier_progress:
            state.failures = 0
        if worker not in self._lost_with_node:
            self._deaths[worker] = state
            self._count_failure(state, cause)
        return [state.job] if state.missing and not state.worker else []

    def worker_back(self, worker: str) -> None:
        """Record that a lost worker has answered again: it was disconnected, not dead.

        Its death is taken back, as ``lost_with_node`` does.  It still holds its job, unless the job was split.
        """
        state = self._take_back_death(worker)
        if state is not None and self._is_current(state):
            state.worker = state.worker or worker
            self._held[worker] = state

    def lost_with_node(self, worker: str) -> None:
        """Record that a worker ended, or will end, because its node failed: its death does not count against its job.

        A death that was counted is taken back while the phase is open, also from the parts of a job that
        was split and from a variation that was quarantined because of it.
        """
        self._lost_with_node.add(worker)
        self._take_back_death(worker)

    def job_failed(self, worker: str, name: tuple[str, int, int, int], cause: str) -> bool:
        """Record that the worker's job raised; returns False, and does nothing, if the worker does not hold this job."""
        state = self._held.get(worker)
        if state is None or state.job.name != name:
            return False
        if self._release(worker):
            self._count_failure(state, cause)
        return True

    def _state(self, identity: Identity) -> _JobState | None:
        phase = self._phases.get((identity.stage, identity.round))
        return phase.state_of.get((identity.task, identity.variation)) if phase else None

    def _is_current(self, state: _JobState) -> bool:
        """Whether the job is unfinished and this is its state: phases close, and jobs are split."""
        phase = self._phases.get((state.job.stage, state.job.round))
        return phase is not None and phase.unfinished.get(state.job.name) is state

    def _release(self, worker: str) -> bool:
        """Release what the worker holds; returns whether that is still to be done."""
        state = self._held.pop(worker, None)
        if state is None:
            return False
        if state.worker == worker:
            state.worker = ""
        return self._is_current(state)

    def _allowed(self, state: _JobState) -> float:
        longest = None if state.job.payload.arrives_at_once else self._longest_gap.get(state.job.kind)
        base = self._lease_s if longest is None else min(self._lease_s, max(self._floor_s, self._factor * longest))
        return base * 2.0 ** min(_MAX_DOUBLINGS, state.expired + state.failures)

    def _count_failure(self, state: _JobState, cause: str) -> None:
        state.failures += 1
        if state.failures < MAX_FAILURES or len(state.job.variations) > 1:
            return
        phase = self._phases[state.job.stage, state.job.round]
        phase.expected -= len(state.missing)
        state.quarantined, state.missing = state.missing, set()
        del phase.unfinished[state.job.name]
        self.quarantined[state.job.name] = cause

    def _take_back_death(self, worker: str) -> _JobState | None:
        """Count the worker's death no longer; returns the job that it counted for, None if it counted for none."""
        state = self._deaths.pop(worker, None)
        for one in (state.parts or [state]) if state else ():
            self._take_back_failure(one)
        return state

    def _take_back_failure(self, state: _JobState) -> None:
        state.failures = max(0, state.failures - 1)
        phase = self._phases.get((state.job.stage, state.job.round))
        if state.quarantined and phase is not None and phase.state_of.get((state.job.task, state.job.first)) is state:
            state.missing, state.quarantined = state.quarantined, set()
            phase.expected += len(state.missing)
            phase.unfinished[state.job.name] = state
            del self.quarantined[state.job.name]

    def _split(self, phase: _PhaseState, state: _JobState) -> _JobState:
        """Replace a job by its parts, after all other jobs; returns the first part."""
        parts = state.parts = list(state.unfinished_parts())
        del phase.unfinished[state.job.name]
        for part in parts:
            phase.add(part)
        return parts[0]
