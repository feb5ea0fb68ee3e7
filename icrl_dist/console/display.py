"""Progress of a run in the terminal: one bar per stage, and events as lines."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from icrl_dist.console.phase_names import stage_text
from icrl_dist.console.terminal import PlainConsole
from icrl_dist.stream.excerpts import plain

ReportEvent = Callable[[dict[str, Any]], None]
"""Shows one event of a run, such as ``{"event": "note", "text": ...}``."""
Show = bool | ReportEvent
"""What a function shows of its progress: True for lines and bars on standard output, False for nothing, or a receiver."""

_PERIOD_S = 10.0
"""Seconds between progress lines where there is no terminal."""


class Display:
    """Shows a run's events as bars and lines, as a context.

    Without a terminal it prints lines only: at the start and the end of a stage, and every ``_PERIOD_S`` seconds.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self._bars: dict[str, TaskID] = {}
        self._printed: dict[str, tuple[float, bool]] = {}
        columns = (
            TextColumn("{task.description:<26}", markup=False),
            BarColumn(24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(compact=True, elapsed_when_finished=False),
            TextColumn("{task.fields[info]}", markup=False),
        )
        self._progress = Progress(*columns, console=console)

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.console.is_terminal:
            self._progress.stop()

    def report(self, event: dict[str, Any]) -> None:
        """Show one event of the learner, the fleet or an evaluation."""
        kind = event["event"]
        if kind == "progress":
            self._stage(event)
        elif kind == "labels":
            self.console.print(
                f"  labels of adapt/{event['round']}: {event['agreement']:.0%} optimal; return {event['label_return']:.1f}"
                f" in the label trials, {event['context_return']:.1f} in the context trials, {event['optimum']:.1f} optimal",
                highlight=False,
            )
        elif kind == "listening":
            where = f"learner on {event['host']} ({event['device']})"
            text = f"{where} listens at {event['endpoint']}, policy version {event['version']}"
            self.console.print(plain(text, 2_000), highlight=False, markup=False)
        elif kind in ("note", "worker", "alert", "crash", "quarantine", "released", "repaired", "interrupted"):
            self.console.print(plain(event["text"], 2_000), highlight=False, markup=False)

    def _stage(self, event: dict[str, Any]) -> None:
        name, info = plain(_name(event)), plain(_info(event), 2_000)
        done, total = event["step"], event["steps"]
        if self.console.is_terminal:
            if name not in self._bars:
                self._bars[name] = self._progress.add_task(name, total=total, info=info)
            self._progress.update(self._bars[name], completed=done, info=info)
            return
        printed_at, ended = self._printed.get(name, (time.monotonic(), False))
        if not ended and (done == total or time.monotonic() - printed_at >= _PERIOD_S or name not in self._printed):
            self._printed[name] = (time.monotonic(), done == total)
            if done or event.get("doing"):
                self.console.print(f"{name:<26} {done:>7}/{total:<7} {info}", highlight=False, markup=False)


@contextlib.contextmanager
def reporting(progress: Show) -> Iterator[ReportEvent]:
    """The function that receives the events of some work, as a context around the work."""
    if callable(progress):
        yield progress
    elif progress:
        with Display(PlainConsole(soft_wrap=True)) as display:
            yield display.report
    else:
        yield lambda event: None


def _name(event: dict[str, Any]) -> str:
    if event["stage"] == "evaluate":
        return str(event["phase"])
    return stage_text(event)


def _info(event: dict[str, Any]) -> str:
    if event["stage"] == "evaluate":
        return ""
    if event["stage"] == "fit":
        return f"loss {event['loss']:.3f}"
    drops = sum(event["drops"].values())
    dropped = f", {drops} dropped" if drops else ""
    policy = f", policy v{event['version']}, lag {event['lag']}" if event["phase"] == "adapt" else ""
    if event.get("doing"):
        return f"{event['workers']} workers{policy}{dropped}; {'; '.join(event['doing'])}"
    return f"{event['per_s']:.0f} trajectories/s, {event['workers']} workers{policy}{dropped}"
