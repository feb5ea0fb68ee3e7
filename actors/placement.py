"""Placement: which worker runs on which node, while nodes join and leave.  Bookkeeping only."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from icrl_dist.config.run import ConfigError

LOCAL_ACTORS = 2
"""Number of workers without a cluster, on a machine with enough cores."""


def local_actors() -> int:
    """The default number of workers on this machine: ``LOCAL_ACTORS``, or 1 if this process may use a single core."""
    return min(LOCAL_ACTORS, len(os.sched_getaffinity(0)))


def check_cores(actors: int) -> None:
    """Raises ConfigError if this machine has fewer than ``actors`` cores: Ray would never start the remaining workers."""
    cores = len(os.sched_getaffinity(0))
    if actors > cores:
        have = "1 core" if cores == 1 else f"{cores} cores"
        raise ConfigError(f"--actors {actors}: this machine has {have} for this process; ask for at most {cores}")


@dataclass
class Node:
    """A cluster node with room for one worker per core."""

    node_id: str
    """Ray's identifier."""
    address: str
    hostname: str
    cores: int
    workers: set[int] = field(default_factory=set)
    """Numbers of the workers on this node."""

    @property
    def free(self) -> int:
        return self.cores - len(self.workers)

    def __str__(self) -> str:
        return f"{self.hostname} ({self.address})" if self.hostname else self.address


class Placement:
    """Assigns workers 0, 1, ... to nodes: ``wanted`` of them, or one per core of all nodes if that is None."""

    def __init__(self, wanted: int | None) -> None:
        self.wanted = wanted
        self.nodes: dict[str, Node] = {}
        """Nodes by their Ray identifier."""
        self.waiting: list[int] = list(range(wanted or 0))
        """Workers without a node, lowest number first."""
        self._count = wanted or 0

    @property
    def capacity(self) -> int:
        """Number of workers that fit on all nodes together."""
        return sum(node.cores for node in self.nodes.values())

    def join(self, node: Node) -> None:
        """Add a node."""
        self.nodes[node.node_id] = node

    def leave(self, node_id: str) -> set[int]:
        """Remove a node; its workers wait for another one.  Returns their numbers."""
        node = self.nodes.pop(node_id, None)
        lost = node.workers if node else set()
        self.waiting = sorted({*self.waiting, *lost})
        return lost

    def node_of(self, worker: int) -> Node | None:
        """The node of a worker; None if it waits for one."""
        return next((node for node in self.nodes.values() if worker in node.workers), None)

    def assign(self) -> list[tuple[int, Node]]:
        """Assign waiting workers to nodes, evenly, while there is room; returns the new (worker, node) pairs."""
        assigned = []
        while (node := self._most_free()) is not None:
            if self.waiting:
                worker = self.waiting.pop(0)
            elif self.wanted is None:
                worker, self._count = self._count, self._count + 1
            else:
                break
            node.workers.add(worker)
            assigned.append((worker, node))
        return assigned

    def _most_free(self) -> Node | None:
        """The node with the largest share of free cores; None if all are occupied."""
        free = [node for node in self.nodes.values() if node.free > 0]
        return max(free, key=lambda n: n.free / n.cores, default=None)

    def summary(self, name: Callable[[int], str]) -> str:
        """One line for the user: the workers of each node.  ``name`` returns the name of a worker."""
        parts = [f"{n}: {_list(n.workers, name)}" for n in self.nodes.values() if n.workers]
        return "; ".join(parts) or "none"


def _list(workers: Iterable[int], name: Callable[[int], str]) -> str:
    names = [name(worker) for worker in sorted(workers)]
    return " ".join(names) if len(names) <= 4 else f"{names[0]} to {names[-1]}, {len(names)} workers"


@dataclass(frozen=True, eq=False)
class EndedWorker:
    """A worker that has ended, by itself or with its node."""

    index: int
    actor: Any
    node_id: str
    error: Exception
    due: float = 0.0
    """Time at which to find out how it ended."""
