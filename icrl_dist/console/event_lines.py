"""The events of a run as lines: one line for a death, however many parts of the system notice it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

_JOIN_S, _DEATH_S = 1.0, 3.0
"""Seconds for which workers that join, and reports about a worker's end, are gathered for one line."""
_TOLD_S = 60.0
"""Seconds in which further reports of an end that is printed are left out."""
_NAMED = 3
_TEXTS = ("note", "worker", "alert", "crash", "quarantine", "released", "repaired", "interrupted")
_DIED = re.compile(r"worker (\S+) died \(")
_SILENT = re.compile(r"(ALERT|alert: over): worker (\S+) has been silent")


@dataclass
class _End:
    """What is known about the end of a worker."""

    at: float
    worker: str = ""
    """Its name; empty as long as only the fleet has reported, which names it without the number of its life."""
    gone: str = ""
    crash: str = ""
    died: str = ""
    """The reports of the learner's link, of the crash record, and of the fleet."""

    def line(self) -> str:
        job, (cause, _, record) = self.gone.partition("; ")[2], self.crash.rpartition("; ")
        what = self.died or cause or self.gone.partition("; ")[0]
        return "; ".join(part for part in (what, job, record) if part)


class EventLines:
    """Gathers events; ``add`` and ``due`` return the lines to be printed now.  Times are of ``time.monotonic``."""

    def __init__(self) -> None:
        self._known: set[str] = set()
        self._joining: list[str] = []
        self._joined_at = 0.0
        self._ends: dict[str, _End] = {}
        self._told: dict[str, _End] = {}
        """The ends that are being gathered, and the last one that was printed, by the first part of the name: ``w0``."""
        self._place = ""

    def add(self, event: dict[str, Any], now: float) -> list[str]:
        """Take in an event that is no progress."""
        kind, text = event["event"], str(event.get("text", ""))
        lines = self.due(now)
        if kind == "worker" and {"worker", "alive"} <= event.keys():
            lines += self._joins(event, now) if event["alive"] else self._ends_with(event["worker"], now, gone=text)
        elif kind == "crash" and self._ending(event.get("worker", ""), now):
            lines += self._ends_with(event["worker"], now, crash=text)
        elif kind == "note" and (found := _DIED.match(text)):
            lines += self._ends_with(found[1], now, died=text)
        elif kind == "alert" and (found := _SILENT.match(text)) and self._ending(found[2], now):
            pass  # its end is reported
        elif kind == "labels":
            lines.append(
                f"labels of adapt/{event['round']}: {event['agreement']:.0%} optimal; return {event['label_return']:.1f} in "
                f"the label trials, {event['context_return']:.1f} in the context trials, {event['optimum']:.1f} optimal"
            )
        elif kind == "listening":
            place = f"learner on {event['host']} ({event['device']}) listens at {event['endpoint']}"
            if place != self._place:  # else a learner that was restarted, which another line says
                lines.append(f"{place}, policy version {event['version']}")
            self._place = place
        elif kind in _TEXTS:
            lines.append(text)
        return lines

    def _joins(self, event: dict[str, Any], now: float) -> list[str]:
        worker = event["worker"]
        known, slot = worker in self._known, _slot(worker)
        self._known.add(worker)
        if slot in self._ends and self._ends[slot].worker == worker:
            del self._ends[slot]  # it was disconnected for a moment
        elif slot in self._told and self._told[slot].worker == worker:
            del self._told[slot]
            return [str(event["text"])]
        elif not known and slot == worker:  # else it replaces one that died
            self._joined_at = self._joined_at if self._joining else now
            self._joining.append(worker)
        return []

    def _ending(self, worker: str, now: float) -> bool:
        """Whether the end of this worker is being gathered, or was printed a short time ago."""
        slot = _slot(worker)
        return slot in self._ends or self._is_told(slot, worker, now)

    def _is_told(self, slot: str, worker: str, now: float) -> bool:
        return slot in self._told and self._told[slot].worker in ("", worker) and now - self._told[slot].at < _TOLD_S

    def _ends_with(self, worker: str, now: float, **report: str) -> list[str]:
        """Add a report to what is known about the end of a worker."""
        slot = _slot(worker)
        if slot not in self._ends:
            if "died" not in report and self._is_told(slot, worker, now):
                self._told[slot].worker = worker
                return []
            if "died" in report and slot in self._told and not self._told[slot].died and now - self._told[slot].at < _TOLD_S:
                self._told[slot].died = report["died"]
                return []
        end = self._ends.setdefault(slot, _End(now))
        if "died" not in report:
            end.worker = worker
        for name, text in report.items():
            setattr(end, name, text)
        return self._tell([slot], now) if end.died and end.gone and end.crash else []

    def due(self, now: float) -> list[str]:
        """The lines whose time has come."""
        lines = []
        if self._joining and now - self._joined_at >= _JOIN_S:
            lines.append(_listed(self._joining, "joined"))
            self._joining = []
        return lines + self._tell([slot for slot, end in self._ends.items() if now - end.at >= _DEATH_S], now)

    def rest(self) -> list[str]:
        """All lines that are still gathered, at the end."""
        joined = [_listed(self._joining, "joined")] if self._joining else []
        self._joining = []
        return joined + self._tell(list(self._ends), 0.0)

    def _tell(self, slots: Sequence[str], now: float) -> list[str]:
        ends = {slot: self._ends.pop(slot) for slot in slots}
        for end in ends.values():
            end.at = now
        self._told |= ends
        many = [end.worker for end in ends.values() if not end.died]
        if len(many) > _NAMED:
            others = [end.line() for end in ends.values() if end.died]
            return [*others, f"{_listed(many, 'are gone')}; their jobs will be leased again"]
        return [end.line() for end in ends.values()]


def _slot(worker: str) -> str:
    """``w0`` for ``w0`` and for ``w0-1``, which replaces it."""
    return worker.partition("-")[0]


def _listed(workers: Sequence[str], what: str) -> str:
    if len(workers) == 1:
        return f"worker {workers[0]} {what}"
    more = f" and {len(workers) - _NAMED} more" if len(workers) > _NAMED else ""
    return f"{len(workers)} workers {what}: {', '.join(workers[:_NAMED])}{more}"
