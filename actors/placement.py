"""Which worker stands on which machine: bookkeeping only, so that machines may come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field


@dataclass
class Machine:
    """A machine with room for as many workers as it has cores to give."""

    node: str
    """Ray's name for it."""
    address: str
    host: str
    cores: int
    workers: set[int] = field(default_factory=set)
    """Numbers of the workers that stand here."""

    @property
    def free(self) -> int:
        return self.cores - len(self.workers)

    def __str__(self) -> str:
        return f"{self.host} ({self.address})" if self.host else self.address


class Placement:
    """Workers 0, 1, ... on machines: ``wanted`` of them, or as many as there is room for if that is None."""

    def __init__(self, wanted: int | None) -> None:
        self.wanted = wanted
        self.machines: dict[str, Machine] = {}
        self.waiting: list[int] = list(range(wanted or 0))
        """Workers without a place, lowest number first."""
        self._count = wanted or 0

    @property
    def room(self) -> int:
        """Workers that all machines together have room for."""
        return sum(machine.cores for machine in self.machines.values())

    def join(self, machine: Machine) -> None:
        """A machine is here."""
        self.machines[machine.node] = machine

    def leave(self, node: str) -> set[int]:
        """A machine is gone; the workers that stood there wait for another place."""
        gone = self.machines.pop(node, None)
        lost = gone.workers if gone else set()
        self.waiting = sorted({*self.waiting, *lost})
        return lost

    def where(self, worker: int) -> Machine | None:
        """The machine on which the worker stands."""
        return next((machine for machine in self.machines.values() if worker in machine.workers), None)

    def settle(self) -> list[tuple[int, Machine]]:
        """Give every waiting worker a place as long as there is one, spread evenly; who stands where now."""
        settled = []
        while (machine := self._emptiest()) is not None:
            if self.waiting:
                worker = self.waiting.pop(0)
            elif self.wanted is None:
                worker, self._count = self._count, self._count + 1
            else:
                break
            machine.workers.add(worker)
            settled.append((worker, machine))
        return settled

    def _emptiest(self) -> Machine | None:
        """The machine with the largest share of its cores free."""
        free = [machine for machine in self.machines.values() if machine.free > 0]
        return max(free, key=lambda m: m.free / m.cores, default=None)

    def landed(self, name: Callable[[int], str]) -> str:
        """Who stands where, for people; ``name`` of each worker."""
        parts = [f"{m}: {_run_of(m.workers, name)}" for m in self.machines.values() if m.workers]
        return "; ".join(parts) or "none"


def _run_of(workers: Iterable[int], name: Callable[[int], str]) -> str:
    names = [name(worker) for worker in sorted(workers)]
    return " ".join(names) if len(names) <= 4 else f"{names[0]} to {names[-1]}, {len(names)} workers"
