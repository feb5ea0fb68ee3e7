"""The Board: which jobs the open phases still need, who holds them, and who is to blame.

A pure state machine: the clock is an argument.  It leases only what the open phases need, for a
quick worker would otherwise drain later phases on stale weights.

A job whose worker died goes out whole again, and only after its second death in parts: the shape
of its batch is part of the floating-point result, and workers killed from outside must not change
the run's digests.  In parts, one variation each, the culprit is found and the others finish.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field

from icrl_dist.types import STAGES, Identity, Job

DEATHS = 3
"""A variation that has ended so many workers, or raised so often, is quarantined."""

_DOUBLINGS = 10


@dataclass(frozen=True)
class Lease:
    """A job for a worker, and how long its next trajectory may take."""

    job: Job
    deadline_s: float


@dataclass(slots=True, eq=False)
class _Slot:
    job: Job
    missing: set[int]
    """Trajectories not stored yet, numbered by row and trial; empty: nothing is left to do."""
    worker: str = ""
    since: float = 0.0
    allowed: float = 0.0
    expired: int = 0
    blame: int = 0
    reached: int = 0
    """How far the work is of whoever has the job now, and at most was of those before."""
    before: int = 0
    pinned: bool = False
    given_up: set[int] = field(default_factory=set)
    """What was missing when it was quarantined."""
    split_into: list[_Slot] = field(default_factory=list)

    def number(self, identity: Identity) -> int:
        """Place among the job's of a trajectory in its variations; -1 for a trial that it has not."""
        job = self.job
        if identity.trial >= job.trials:
            return -1
        row = (identity.task - job.task) * (len(job.variations) // job.tasks) + identity.variation - job.first
        return row * job.trials + identity.trial

    def parts(self) -> Iterator[_Slot]:
        """A slot for each variation that something is missing of."""
        trials = self.job.trials
        for row, (task, variation) in enumerate(self.job.rows()):
            missing = {n - row * trials for n in self.missing if n // trials == row}
            if missing:
                one = (self.job.variations[row],)
                job = dataclasses.replace(self.job, task=task, variations=one, tasks=1, first=variation)
                yield _Slot(job, missing, expired=self.expired, blame=DEATHS - 1, pinned=self.pinned)


@dataclass(slots=True)
class _Phase:
    slots: dict[tuple[str, int, int, int], _Slot]
    """What is not finished, in the order of leasing."""
    slot_of: dict[tuple[int, int], _Slot] = field(default_factory=dict)
    """The slot of each task and variation."""
    expected: int = 0
    arrived: int = 0
    leases: int = 0

    def put(self, slot: _Slot) -> None:
        self.slots[slot.job.name] = slot
        self.slot_of.update(dict.fromkeys(slot.job.rows(), slot))


class Board:
    """The jobs of the open phases; a job is done when every trajectory of it is stored."""

    def __init__(self, lease_s: float, floor_s: float = 5.0, factor: float = 10.0) -> None:
        """A lease runs out ``factor`` times the longest gap between trajectories after the last one.

        Never sooner than ``floor_s``, never later than ``lease_s``, which holds while nothing has
        been measured; twice as late for a job each time that it came back unfinished.
        """
        self._lease_s, self._floor_s, self._factor = lease_s, floor_s, factor
        self._phases: dict[tuple[str, int], _Phase] = {}
        self._holding: dict[str, _Slot] = {}
        self._deaths: dict[str, _Slot] = {}
        self._excused: set[str] = set()
        self._longest: dict[str, float] = {}
        self.quarantined: dict[tuple[str, int, int, int], str] = {}
        """Variations given up, as (stage, round, task, variation), and why."""

    def open(self, jobs: Sequence[Job], have: Callable[[Job], Collection[Identity]]) -> None:
        """Begin a phase, or begin it anew, beside those that are open.

        ``have`` tells what is stored of a job, which is not asked for again.  Raises ValueError
        if the jobs belong to several phases.
        """
        names = {(job.stage, job.round) for job in jobs}
        if len(names) > 1:
            raise ValueError(f"jobs of {len(names)} phases, {sorted(names)}: open one phase at a time")
        for name in names:
            self.close(*name)
            phase = self._phases[name] = _Phase({})
            self.quarantined = {key: cause for key, cause in self.quarantined.items() if key[:2] != name}
            for job in jobs:
                slot = _Slot(job, set(range(len(job.variations) * job.trials)))
                slot.missing.difference_update([slot.number(i) for i in have(job)])
                phase.put(slot)
                phase.expected += len(job.variations) * job.trials
                phase.arrived += len(job.variations) * job.trials - len(slot.missing)
                if not slot.missing:
                    del phase.slots[job.name]

    def close(self, stage: str, round: int) -> None:
        """Forget what a phase still needs; what is quarantined of it stays known."""
        self._phases.pop((stage, round), None)

    def progress(self, stage: str, round: int) -> tuple[int, int]:
        """Trajectories stored and expected; what is quarantined is not expected any more."""
        phase = self._phases.get((stage, round))
        return (phase.arrived, phase.expected) if phase else (0, 0)

    def done(self, stage: str, round: int) -> bool:
        """Whether nothing of this phase is missing."""
        phase = self._phases.get((stage, round))
        return phase is None or not phase.slots

    def leases(self, stage: str, round: int) -> int:
        """Leases given in a phase, repeats included."""
        phase = self._phases.get((stage, round))
        return phase.leases if phase else 0

    def blamed(self, stage: str | None = None, round: int | None = None) -> list[tuple[str, str]]:
        """What is quarantined in a phase, or in all: ``adapt/0/3/1`` and why, in canonical order."""
        found = sorted(self.quarantined.items(), key=lambda item: (STAGES.index(item[0][0]), *item[0][1:]))
        return [("/".join(map(str, key)), cause) for key, cause in found if stage in (None, key[0]) and round in (None, key[1])]

    def lease(self, worker: str, now: float, acting: Callable[[Job], int] | None = None) -> Lease | None:
        """The first job that nobody holds or whose lease ran out; None if there is none now.

        A worker asks only when it holds nothing, so what it held before comes back first.
        ``acting`` gives the weights version of a job that goes out for the first time; it keeps
        it, so that whoever repeats the job acts with the same T^j.
        """
        self.back(worker)
        self._release(worker)
        found = next(
            (
                (phase, slot)
                for phase in self._phases.values()
                for slot in phase.slots.values()
                if not slot.worker or now >= slot.since + slot.allowed
            ),
            None,
        )
        if found is None:
            return None
        phase, slot = found
        slot.expired += bool(slot.worker)
        if slot.blame >= DEATHS - 1 and len(slot.job.variations) > 1:
            slot = self._split(phase, slot)
        if acting is not None and not slot.pinned:
            slot.job = dataclasses.replace(slot.job, policy_version=acting(slot.job))
        slot.pinned = True
        slot.worker, slot.since, slot.allowed = worker, now, self._allowed(slot)
        slot.reached, slot.before = 0, max(slot.before, slot.reached)
        self._holding[worker] = slot
        phase.leases += 1
        return Lease(slot.job, slot.allowed)

    def wants(self, identity: Identity) -> Job | None:
        """The job that still needs this trajectory, if any."""
        slot = self._slot(identity)
        return slot.job if slot and slot.number(identity) in slot.missing else None

    def received(self, identity: Identity, now: float) -> None:
        """A trajectory is stored; its job's lease runs from now, for its holder is at work."""
        slot = self._slot(identity)
        if slot is None or (number := slot.number(identity)) not in slot.missing:
            return
        if slot.worker:
            gap = now - slot.since
            self._longest[slot.job.kind] = max(gap, self._longest.get(slot.job.kind, 0.0))
        slot.since = now
        slot.missing.remove(number)
        phase = self._phases[identity.stage, identity.round]
        phase.arrived += 1
        if not slot.missing:
            del phase.slots[slot.job.name]

    def repeated(self, identity: Identity, now: float) -> None:
        """A trajectory came that was stored before: whoever repeats its job is at work."""
        slot = self._slot(identity)
        if slot is not None:
            slot.since = now

    def reached(self, worker: str, job: str, how_far: int) -> None:
        """The worker says how far it is in a job that takes long before its first trajectory."""
        slot = self._holding.get(worker)
        if slot is not None and slot.job.label == job:
            slot.reached = max(slot.reached, how_far)

    def lost(self, worker: str, now: float, cause: str = "its worker died") -> list[Job]:
        """The worker is gone: its unfinished job is to blame, and goes to the next who asks.

        That holds even if its lease had run out before and another has the job now; but nothing that was
        before is held against a job which got further than ever: it goes on from a checkpoint, and
        worker after worker may be killed from outside.  Returns what is free again.
        """
        slot = self._holding.get(worker)
        if slot is None or not self._release(worker):
            return []
        if slot.reached > slot.before:
            slot.blame = 0
        if worker not in self._excused:
            self._deaths[worker] = slot
            self._accuse(slot, cause)
        return [slot.job] if slot.missing and not slot.worker else []

    def back(self, worker: str) -> None:
        """A worker that was lost is heard of: it was cut off, not dead, and still holds its job.

        The death is taken back, unless it has split or quarantined the job already.
        """
        slot = self._deaths.pop(worker, None)
        if slot is not None and self._open(slot):
            slot.blame -= 1
            slot.worker = slot.worker or worker
            self._holding[worker] = slot

    def excuse(self, worker: str) -> None:
        """The worker went, or is about to go, with its machine: no job is to blame for that.

        Its death is taken back even from the parts of a job that it has split, and from a variation
        that it has quarantined, as long as their phase is open.
        """
        self._excused.add(worker)
        slot = self._deaths.pop(worker, None)
        for one in (slot.split_into or [slot]) if slot else ():
            self._pardon(one)

    def failed(self, worker: str, name: tuple[str, int, int, int], cause: str) -> None:
        """The worker reports that its job raised; one that it does not hold (any more) is no news."""
        slot = self._holding.get(worker)
        if slot is not None and slot.job.name == name and self._release(worker):
            self._accuse(slot, cause)

    def _slot(self, identity: Identity) -> _Slot | None:
        phase = self._phases.get((identity.stage, identity.round))
        return phase.slot_of.get((identity.task, identity.variation)) if phase else None

    def _open(self, slot: _Slot) -> bool:
        """Whether the job is still to be done, and by this slot: phases close, jobs are split."""
        phase = self._phases.get((slot.job.stage, slot.job.round))
        return phase is not None and phase.slots.get(slot.job.name) is slot

    def _release(self, worker: str) -> bool:
        """The worker holds nothing any more; whether what it held is still to be done."""
        slot = self._holding.pop(worker, None)
        if slot is None:
            return False
        if slot.worker == worker:
            slot.worker = ""
        return self._open(slot)

    def _allowed(self, slot: _Slot) -> float:
        longest = None if slot.job.payload.arrives_at_once else self._longest.get(slot.job.kind)
        base = self._lease_s if longest is None else min(self._lease_s, max(self._floor_s, self._factor * longest))
        return base * 2.0 ** min(_DOUBLINGS, slot.expired + slot.blame)

    def _accuse(self, slot: _Slot, cause: str) -> None:
        slot.blame += 1
        if slot.blame < DEATHS or len(slot.job.variations) > 1:
            return
        phase = self._phases[slot.job.stage, slot.job.round]
        phase.expected -= len(slot.missing)
        slot.given_up, slot.missing = slot.missing, set()
        del phase.slots[slot.job.name]
        self.quarantined[slot.job.name] = cause

    def _pardon(self, slot: _Slot) -> None:
        slot.blame = max(0, slot.blame - 1)
        phase = self._phases.get((slot.job.stage, slot.job.round))
        if slot.given_up and phase is not None and phase.slot_of.get((slot.job.task, slot.job.first)) is slot:
            slot.missing, slot.given_up = slot.given_up, set()
            phase.expected += len(slot.missing)
            phase.slots[slot.job.name] = slot
            del self.quarantined[slot.job.name]

    def _split(self, phase: _Phase, slot: _Slot) -> _Slot:
        """The job in parts, behind everything else; returns the first part."""
        parts = slot.split_into = list(slot.parts())
        del phase.slots[slot.job.name]
        for part in parts:
            phase.put(part)
        return parts[0]
