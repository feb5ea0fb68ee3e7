"""The Board: which jobs the present phase still needs, and who holds them.

A pure state machine: the clock is an argument.  It leases only what this phase needs, for a
quick worker would otherwise drain later phases on stale weights.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from icrl_dist.types import Identity, Job


@dataclass
class _Slot:
    job: Job
    missing: set[Identity]
    worker: str = ""
    deadline: float = 0.0
    failures: list[str] = field(default_factory=list)


class Board:
    """Jobs of one phase after another; a job is done when every trajectory of it is stored."""

    def __init__(self, lease_s: float, max_failures: int = 3) -> None:
        self._lease_s, self._max_failures = lease_s, max_failures
        self._slots: dict[tuple[str, int, int], _Slot] = {}
        self._slot_of: dict[tuple[str, int, int], _Slot] = {}
        self.expected = 0
        self.arrived = 0
        self.leases = 0
        """Leases given in this phase, repeats included."""

    def open(self, jobs: Sequence[Job], stored: Iterable[Identity]) -> None:
        """Begin a phase; what is ``stored`` already is not asked for again."""
        have = set(stored)
        self._slots = {job.name: _Slot(job, set(job.identities()) - have) for job in jobs}
        self._slot_of = {i[:3]: slot for slot in self._slots.values() for i in slot.job.identities()}
        self.expected = sum(len(job.variations) * job.trials for job in jobs)
        self.arrived = self.expected - sum(len(slot.missing) for slot in self._slots.values())
        self.leases = 0

    @property
    def done(self) -> bool:
        return self.arrived == self.expected

    def lease(self, worker: str, now: float) -> Job | None:
        """The first job that nobody holds or whose lease ran out; None if there is none now.

        A worker asks only when it holds nothing, so what it held before comes back first.
        """
        self.lost(worker)
        for slot in self._slots.values():
            if slot.missing and (not slot.worker or now >= slot.deadline):
                slot.worker, slot.deadline = worker, now + self._lease_s
                self.leases += 1
                return slot.job
        return None

    def wants(self, identity: Identity) -> Job | None:
        """The job that still needs this trajectory, if any."""
        slot = self._slot_of.get(identity[:3])
        return slot.job if slot and identity in slot.missing else None

    def received(self, identity: Identity, now: float) -> None:
        """A trajectory is stored; its job's lease is extended, for its holder is at work."""
        slot = self._slot_of.get(identity[:3])
        if slot and identity in slot.missing:
            slot.missing.remove(identity)
            slot.deadline = max(slot.deadline, now + self._lease_s)
            self.arrived += 1

    def lost(self, worker: str) -> list[Job]:
        """The worker is gone: its unfinished jobs go to the next who ask."""
        freed = []
        for slot in self._slots.values():
            if slot.worker == worker:
                slot.worker = ""
                if slot.missing:
                    freed.append(slot.job)
        return freed

    def failed(self, name: tuple[str, int, int], error: str) -> str | None:
        """A worker reports that the job raised.

        Returns None while it may be tried again, else one line that says why it may not.
        """
        slot = self._slots.get(name)
        if slot is None:
            return None
        slot.worker = ""
        slot.failures.append(error)
        if len(slot.failures) < self._max_failures:
            return None
        return f"job {slot.job.label} failed {len(slot.failures)} times, last: {error}"
