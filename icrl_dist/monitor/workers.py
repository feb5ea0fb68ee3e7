"""The workers as the live view knows them: from their heartbeats and the learner's word."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.telemetry import crash_reports

SILENT_S = 2.0
"""A worker whose last heartbeat is older is called silent; they come twice a second."""
_MOST = 1024
_SPAN_S = 3.0
"""Rates are means over about so long."""
_COUNTS = ("episodes", "steps", "resent", "trajectories", "pid")


@dataclass(slots=True)
class _Row:
    beaten: float
    alive: bool = True
    restarts: int = 0
    said: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(_COUNTS, 0) | _NOTHING)
    marks: deque[tuple[float, int, int]] = field(default_factory=deque)
    """When it had done how many steps and episodes."""


_NOTHING: dict[str, Any] = {"job": "", "doing": "", "memory_mb": 0.0, "peak_mb": 0.0, "policy_version": -1}


class WorkerTable:
    """A bounded table of workers."""

    def __init__(self, beats: bool = True) -> None:
        """``beats``: there are heartbeats, so that a worker without them is silent; else it waits."""
        self._rows: dict[str, _Row] = {}
        self._beats = beats

    def beat(self, message: dict[str, Any], now: float) -> None:
        """A heartbeat."""
        said: dict[str, Any] = {name: validation.integer(message.get(name), 0) for name in _COUNTS}
        said |= {name: validation.text(message.get(name)) for name in ("job", "doing")}
        said |= {name: validation.number(message.get(name)) for name in ("memory_mb", "peak_mb")}
        said["policy_version"] = validation.integer(message.get("policy_version", -1), -1)
        row = self._row(validation.text(message.get("worker")), now)
        if row.said["pid"] not in (0, said["pid"]):
            row.restarts += 1
            row.marks.clear()
        row.said, row.beaten, row.alive = said, now, True

    def came(self, worker: str, alive: bool, now: float) -> None:
        """The learner says that it joined, or is gone."""
        row = self._row(worker, now)
        row.alive = alive
        if alive:
            row.beaten = now
        else:
            row.said |= {"job": "", "doing": ""}

    def _row(self, worker: str, now: float) -> _Row:
        row = self._rows.get(worker)
        if row is None:
            if len(self._rows) >= _MOST:
                raise InvalidMessageError("too many workers")
            row = self._rows[worker] = _Row(now)
            before = crash_reports.predecessor(worker)
            if before is not None and before in self._rows and not self._rows[before].alive:
                row.restarts = self._rows.pop(before).restarts + 1
        return row

    def tick(self, now: float) -> None:
        """Rates are taken from where the counts stood some seconds ago."""
        for row in self._rows.values():
            while row.marks and row.marks[-1][0] >= now:  # a recording stands still, or a clock was set back
                row.marks.pop()
            row.marks.append((now, row.said["steps"], row.said["episodes"]))
            while len(row.marks) > 2 and now - row.marks[1][0] >= _SPAN_S:
                row.marks.popleft()

    def rows(self, now: float, over: bool = False, version: int = -1) -> list[dict[str, Any]]:
        """A row a worker, by name; ``state`` is gone, silent, waiting or working, and done once the run is ``over``.

        ``version``: the newest of the weights; ``lag`` says how many versions older those are that
        act in a worker's job, 0 if none do.
        """
        rows = [_told(name, row, now, over, self._beats) for name, row in sorted(self._rows.items())]
        for row in rows:
            row["lag"] = max(0, version - row["policy_version"]) if row["policy_version"] >= 0 and row["job"] else 0
        return rows


def _told(name: str, row: _Row, now: float, over: bool, beats: bool) -> dict[str, Any]:
    silent = max(0.0, now - row.beaten)
    state = (
        "done"
        if over
        else "gone"
        if not row.alive
        else ("silent" if beats else "waiting")
        if silent > SILENT_S
        else "working"
        if row.said["job"]
        else "waiting"
    )
    steps_per_s = episodes_per_s = 0.0
    if len(row.marks) > 1 and state in ("working", "waiting"):
        then, steps, episodes = row.marks[0]
        span = max(1e-3, row.marks[-1][0] - then)
        steps_per_s = max(0, row.marks[-1][1] - steps) / span
        episodes_per_s = max(0, row.marks[-1][2] - episodes) / span
    return {
        "name": name,
        "state": state,
        **(row.said | {"job": ""} if state == "waiting" else row.said),
        "steps_per_s": steps_per_s,
        "episodes_per_s": episodes_per_s,
        "unstored": max(0, row.said["episodes"] - row.said["trajectories"]),
        "restarts": row.restarts,
        "silent_s": round(silent, 1),
    }
