"""One row for a stage of a run: name, bar, percent, time left, and as much text as fits."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from rich.cells import cell_len, set_cell_size

from icrl_dist.console.phase_names import stage_text

_TIME, _PERCENT = len("23:59:59 left"), len("100%")
_MIN_BAR, _NAME, _LEAST = 4, 25, 10
_STILL_S = 20.0
"""Seconds without a step after which a row says what the run waits for."""
_SAMPLES = 256


def duration(seconds: float) -> str:
    """``0:42``, ``1:02:03``, ``3d 04h``; at most eight characters."""
    if not math.isfinite(seconds) or seconds >= 1000 * 86400:
        return ">999d"
    whole = max(0, round(seconds))
    days, hours, minutes, rest = whole // 86400, whole // 3600 % 24, whole // 60 % 60, whole % 60
    if days:
        return f"{days}d {hours:02}h"
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Pace:
    """Estimates the time that is left, from the steps of this session in the later half of its time.

    Times are of a clock that is never set, such as ``time.monotonic``.
    """

    def __init__(self, now: float, done: int) -> None:
        self._samples = deque([(now, done)])
        self.began, self.moved = now, now
        """When the stage began in this session, and when its number of steps last changed."""
        self.done = done

    def add(self, now: float, done: int) -> None:
        if done == self.done:
            return
        self.done, self.moved = done, now
        if now - self._samples[-1][0] >= 1.0:
            self._samples.append((now, done))
        if len(self._samples) > _SAMPLES:
            self._samples = deque(list(self._samples)[::2])

    def left(self, now: float, total: int) -> float:
        """Seconds; infinite before the first step."""
        since = now - max(60.0, (now - self.began) / 2)
        then, done = next((one for one in self._samples if one[0] >= since), self._samples[-1])
        if self.done <= done:
            then, done = self._samples[0]
        if self.done <= done:
            return math.inf
        return (total - self.done) * (now - then) / (self.done - done)


class StageRow:
    """A stage of a run, from its progress events."""

    def __init__(self, event: dict[str, Any], now: float) -> None:
        self.name = name_of(event)
        self._pace = Pace(now, event["step"])
        self.update(event, now)

    def update(self, event: dict[str, Any], now: float) -> None:
        """``event``: a progress event of this stage; ``now``: as in ``Pace``."""
        self.event, self._reported = event, now
        self._pace.add(now, event["step"])

    @property
    def finished(self) -> bool:
        return bool(self.event["step"] >= self.event["steps"])

    def time(self, now: float) -> str:
        if self.finished:
            return duration(self._pace.moved - self._pace.began)
        left = self._pace.left(now, self.event["steps"])
        return f"{duration(left) if math.isfinite(left) else '--:--'} left"

    def percent(self) -> str:
        done, total = self.event["step"], self.event["steps"]
        return f"{100 * done // total if total and not self.finished else 100}%"

    def text(self, now: float) -> str:
        """Counts and rates, or what the run waits for; of a sweep the text of its event."""
        if self.event["stage"] == "sweep":
            return str(self.event["text"])
        return self._still(now) or f"{self.event['step']}/{self.event['steps']}{_info(self.event)}"

    def _still(self, now: float) -> str:
        """What the stage waits for; empty while it makes progress."""
        event, still = self.event, now - self._pace.moved
        if self.finished or event.get("doing"):
            return ""
        if event["stage"] == "collect" and not event["workers"]:
            return "waits for a worker"
        if still < _STILL_S:
            return ""
        if event["stage"] == "collect":
            if now - self._reported > _STILL_S:
                return f"learner silent {duration(now - self._reported)}"
            return f"nothing for {duration(still)}: waits for trajectories of {_workers(event)}"
        return f"no {'step' if event['stage'] == 'fit' else 'episode'} for {duration(still)}"

    def line(self, now: float) -> str:
        """The row without a bar, for a file."""
        name = fitted(self.name, max(_NAME, cell_len(self.name)))
        return f"{name} {self.percent():>{_PERCENT}}  {self.time(now):<{_TIME}}  {self.text(now)}".rstrip()

    def fit(self, width: int, now: float, ascii_only: bool) -> str:
        """The row in at most ``width`` cells: the text gives way first, then the bar and the name become shorter."""
        fixed = _PERCENT + _TIME + 3
        name = min(_NAME, max(width - fixed - _MIN_BAR, 0))
        bar = max(0, min(24 if width >= 100 else 10, width - fixed - name))
        share = self.event["step"] / self.event["steps"] if self.event["steps"] else 1.0
        full = bar if self.finished else min(bar - 1, int(share * bar)) if bar else 0
        marks = "#." if ascii_only else "█░"
        row = f"{fitted(self.name, name)} {marks[0] * full}{marks[1] * (bar - full)} "
        row += f"{self.percent():>{_PERCENT}} {self.time(now):<{_TIME}}"
        space = width - cell_len(row) - 1
        return fitted(f"{row} {fitted(self.text(now), space)}" if space >= _LEAST else row, width).rstrip()


def fitted(text: str, width: int) -> str:
    """Text padded to ``width`` cells, or cut with a mark at its end.  Some characters take two cells."""
    return (
        set_cell_size(text, width) if cell_len(text) <= width else set_cell_size(text, max(0, width - 1)) + "…"[: max(0, width)]
    )


def name_of(event: dict[str, Any]) -> str:
    """The name of the stage of a progress event."""
    return str(event["phase"]) if event["stage"] in ("evaluate", "sweep") else stage_text(event)


def _info(event: dict[str, Any]) -> str:
    if event["stage"] == "evaluate":
        return ""
    if event["stage"] == "fit":
        return f", loss {event['loss']:.3f}"
    drops = sum(event["drops"].values())
    parts = [_workers(event)]
    parts += [f"lag {event['lag']}"] if event["phase"] == "adapt" and event["lag"] else []
    parts += [f"{drops} dropped"] if drops else []
    if event.get("doing"):
        return f", {', '.join(parts)}; {'; '.join(event['doing'])}"
    return f" {event['per_s']:.0f}/s {', '.join(parts)}"


def _workers(event: dict[str, Any]) -> str:
    return f"{event['workers']} worker{'' if event['workers'] == 1 else 's'}"
