"""State of the workers, from their heartbeats and the learner's events."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.telemetry import crash_reports

SILENT_S = 2.0
"""A worker is ``silent`` if its last heartbeat is older; heartbeats arrive twice a second."""
_MAX_WORKERS = 1024
_SPAN_S = 3.0
"""Rates are means over about this time."""
_COUNTS = ("episodes", "steps", "resent", "trajectories", "pid")


@dataclass(slots=True)
class _Worker:
    last_heartbeat: float
    alive: bool = True
    restarts: int = 0
    heartbeat: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(_COUNTS, 0) | _IDLE)
    """Fields of its newest heartbeat."""
    history: deque[tuple[float, int, int]] = field(default_factory=deque)
    """Time, steps and episodes at recent ticks."""


_IDLE: dict[str, Any] = {"job": "", "doing": "", "memory_mb": 0.0, "peak_mb": 0.0, "policy_version": -1}


class WorkerTable:
    """A table of workers with a limit on their number."""

    def __init__(self, heartbeats: bool = True) -> None:
        """``heartbeats``: False if heartbeats are not recorded; a worker is then ``waiting`` instead of ``silent``."""
        self._workers: dict[str, _Worker] = {}
        self._heartbeats = heartbeats

    def heartbeat(self, message: dict[str, Any], now: float) -> None:
        """Take in a ``worker`` message.  Raises InvalidMessageError."""
        fields: dict[str, Any] = {name: validation.integer(message.get(name), 0) for name in _COUNTS}
        fields |= {name: validation.text(message.get(name)) for name in ("job", "doing")}
        fields |= {name: validation.number(message.get(name)) for name in ("memory_mb", "peak_mb")}
        fields["policy_version"] = validation.integer(message.get("policy_version", -1), -1)
        worker = self._worker(validation.text(message.get("worker")), now)
        if worker.heartbeat["pid"] not in (0, fields["pid"]):
            worker.restarts += 1
            worker.history.clear()
        worker.heartbeat, worker.last_heartbeat, worker.alive = fields, now, True

    def set_alive(self, name: str, alive: bool, now: float) -> None:
        """Take in the learner's event that a worker joined or left.  Raises InvalidMessageError."""
        worker = self._worker(name, now)
        worker.alive = alive
        if alive:
            worker.last_heartbeat = now
        else:
            worker.heartbeat |= {"job": "", "doing": ""}

    def _worker(self, name: str, now: float) -> _Worker:
        worker = self._workers.get(name)
        if worker is None:
            if len(self._workers) >= _MAX_WORKERS:
                raise InvalidMessageError("too many workers")
            worker = self._workers[name] = _Worker(now)
            before = crash_reports.predecessor(name)
            if before is not None and before in self._workers and not self._workers[before].alive:
                worker.restarts = self._workers.pop(before).restarts + 1
        return worker

    def tick(self, now: float) -> None:
        """Record the counts, from which ``rows`` computes rates."""
        for worker in self._workers.values():
            history = worker.history
            while history and history[-1][0] >= now:  # a recording is paused, or a clock was set back
                history.pop()
            history.append((now, worker.heartbeat["steps"], worker.heartbeat["episodes"]))
            while len(history) > 2 and now - history[1][0] >= _SPAN_S:
                history.popleft()

    def rows(self, now: float, over: bool = False, version: int = -1) -> list[dict[str, Any]]:
        """One row a worker, sorted by name.

        ``state`` is gone, silent, waiting or working, or done if the run is ``over``.  ``lag`` is the
        number of versions between the newest weights, ``version``, and the weights of the worker's
        job; 0 if the job uses none.
        """
        rows = [_row(name, worker, now, over, self._heartbeats) for name, worker in sorted(self._workers.items())]
        for row in rows:
            row["lag"] = max(0, version - row["policy_version"]) if row["policy_version"] >= 0 and row["job"] else 0
        return rows


def _row(name: str, worker: _Worker, now: float, over: bool, heartbeats: bool) -> dict[str, Any]:
    silent, fields, history = max(0.0, now - worker.last_heartbeat), worker.heartbeat, worker.history
    if over:
        state = "done"
    elif not worker.alive:
        state = "gone"
    elif silent > SILENT_S:
        state = "silent" if heartbeats else "waiting"
    else:
        state = "working" if fields["job"] else "waiting"
    steps_per_s = episodes_per_s = 0.0
    if len(history) > 1 and state in ("working", "waiting"):
        began, steps, episodes = history[0]
        span = max(1e-3, history[-1][0] - began)
        steps_per_s = max(0, history[-1][1] - steps) / span
        episodes_per_s = max(0, history[-1][2] - episodes) / span
    return {
        "name": name,
        "state": state,
        **(fields | {"job": ""} if state == "waiting" else fields),
        "steps_per_s": steps_per_s,
        "episodes_per_s": episodes_per_s,
        "unstored": max(0, fields["episodes"] - fields["trajectories"]),
        "restarts": worker.restarts,
        "silent_s": round(silent, 1),
    }
