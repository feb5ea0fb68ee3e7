"""The workers that the learner knows: whether each is connected, and its newest counters; a table with a bound."""

from __future__ import annotations

import time
from collections.abc import Container
from typing import Any

from icrl_dist.stream.excerpts import plain
from icrl_dist.stream.messages import Progress

MAX_WORKERS = 4096
"""Names that are known at once; beyond them, those without a connection and a job are forgotten first."""

_MAX_LONG_WORK = 64
"""Texts about long work in a message to views."""

_MAX_SILENT = 256
"""Workers whose silence may be an alert: those that have been silent for the longest time."""

_COUNTS = ("episodes", "steps", "resent", "trajectories", "waited_s")


class KnownWorkers:
    """The table; its owner guards the methods that change it with a lock."""

    def __init__(self) -> None:
        self.alive: dict[str, bool] = {}
        """Whether each worker that has ever connected is alive."""
        self.counters: dict[str, dict[str, Any]] = {}
        """The newest counters of each worker: episodes, steps, resent, memory_mb and so on."""
        self.last_message: dict[str, float] = {}

    def admit(self, worker: str, busy: Container[str]) -> bool:
        """Whether there is room for this worker.  One that is neither connected nor ``busy`` may be forgotten for it."""
        if worker in self.alive or worker in self.counters or len(self.alive) + len(self.counters) < MAX_WORKERS:
            return True
        names = dict.fromkeys((*self.alive, *self.counters))
        if len(names) < MAX_WORKERS:
            return True
        idle = next((name for name in names if not self.alive.get(name) and name not in busy), None)
        if idle is None:
            return False
        for table in (self.alive, self.counters, self.last_message):
            table.pop(idle, None)
        return True

    def count(self, progress: Progress, fields: dict[str, Any]) -> None:
        """Keep a worker's newest counters, which never decrease, because heartbeats may arrive late.

        ``fields``: those that the message holds; only they replace older ones.
        """
        worker = progress.worker
        before = self.counters.get(worker, {})
        counts = {name: max(getattr(progress, name), before.get(name, 0)) for name in _COUNTS}
        self.counters[worker] = {**before, **{name: getattr(progress, name) for name in fields}, **counts}
        self.last_message[worker] = time.monotonic()

    @property
    def resent(self) -> int:
        """How often trajectories were sent again, by all workers so far."""
        return sum(counters["resent"] for counters in list(self.counters.values()))

    @property
    def totals(self) -> dict[str, Any]:
        """Sums of the counters of all workers, and by worker the seconds waited and the seconds since its last message."""
        now, known, alive = time.monotonic(), dict(self.counters), dict(self.alive)  # copies: other threads change them
        counters = known.values()
        silent = [(worker, last) for worker, last in dict(self.last_message).items() if worker in alive]
        silent.sort(key=lambda one: one[1])
        return {
            "episodes": sum(one["episodes"] for one in counters),
            "acknowledged": sum(one["trajectories"] for one in counters),
            "resent": self.resent,
            "waited_s": sum(one["waited_s"] for one in counters),
            "waited": {worker: known[worker]["waited_s"] for worker in known if alive.get(worker)},
            "silent": {worker: now - last for worker, last in silent[:_MAX_SILENT]},
        }

    @property
    def long_work(self) -> list[str]:
        """What each connected worker reports about a job with a long time before its first trajectory."""
        connected = [worker for worker, alive in sorted(self.alive.items()) if alive]
        texts = (str(self.counters.get(worker, {}).get("doing", "")) for worker in connected)
        return [f"{worker}: {plain(text, 100)}" for worker, text in zip(connected, texts, strict=True) if text][:_MAX_LONG_WORK]
