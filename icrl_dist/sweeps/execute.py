"""Does the runs of a sweep side by side: starts their processes, follows their states, and gathers how they ended."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from icrl_dist.console.display import ReportEvent
from icrl_dist.console.stage_rows import duration
from icrl_dist.sweeps import state
from icrl_dist.sweeps.one import DONE, FAILED, Keep, Work, ended_unwritten
from icrl_dist.sweeps.plan import Member
from icrl_dist.sweeps.processes import Process, Start

STOP_S = 60.0
"""Seconds that a run has to write its checkpoint when the sweep is interrupted."""
_POLL_S, _SHOW_S = 0.05, 1.0


@dataclass(frozen=True)
class Failure:
    """A run that did not end well."""

    member: Member
    cause: str
    log: Path


class Execution:
    """The runs that are not done yet, ``jobs`` at a time."""

    def __init__(self, missing: Sequence[Member], done: int, out: Path, keep: Keep, jobs: int, start: Start) -> None:
        """``done``: number of runs that were done before; ``out``: an absolute path."""
        self._waiting, self._done, self._before = list(missing), done, done
        self._out, self._keep, self._jobs, self._start = out, keep, jobs, start
        self._running: dict[str, tuple[Member, Process]] = {}
        self._total = done + len(missing)
        self._shown = float("-inf")
        self.failures: list[Failure] = []

    def run(self, show: ReportEvent, stopped: Callable[[], bool]) -> bool:
        """Do all runs; returns False if ``stopped()`` became true before the end.  No process is left in any case."""
        try:
            while self._waiting or self._running:
                if stopped():
                    return False
                while self._waiting and len(self._running) < self._jobs:
                    self._begin(self._waiting.pop(0))
                self._gather(show)
                self._show(show)
                time.sleep(_POLL_S)
            self._show(show, now=True)
            return True
        finally:
            self._end()

    def _begin(self, member: Member) -> None:
        folder = member.place(self._out)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._running[member.name] = (member, self._start(Work(member, self._out, self._keep).message(), state.log_of(folder)))

    def _gather(self, show: ReportEvent) -> None:
        for name, (member, process) in list(self._running.items()):
            if (code := process.poll()) is None:
                continue
            del self._running[name]
            folder = member.place(self._out)
            found = state.read(folder)
            if code == DONE and found.done(member):
                self._done += 1
                text = f"{name}: done in {duration(found.seconds)}{_returns(found.returns)}"
            else:
                cause = (
                    found.failed
                    if code == FAILED and found.failed
                    else process.error or ended_unwritten(code, folder) or _ended(code)
                )
                self.failures.append(Failure(member, cause, state.log_of(folder)))
                text = f"{name}: failed: {cause}"
            show({"event": "note", "text": text})

    def _show(self, show: ReportEvent, now: bool = False) -> None:
        if not now and time.monotonic() - self._shown < _SHOW_S:
            return
        self._shown = time.monotonic()
        states = {name: state.read(member.place(self._out)) for name, (member, _) in self._running.items()}
        ended = self._done + len(self.failures)
        part = sum(found.share for found in states.values() if found.phase != "done")
        texts = [f"{ended}/{self._total} runs"] + [f"{name} {found.phase}" for name, found in states.items()]
        step = int(1000 * (ended + part)) if states or self._waiting else 1000 * self._total
        text = "; ".join(texts)
        show({"event": "progress", "stage": "sweep", "phase": "sweep", "step": step, "steps": 1000 * self._total, "text": text})

    def _end(self) -> None:
        """End the running processes, each with a checkpoint if its time suffices."""
        for _, process in self._running.values():
            if process.poll() is None:
                process.stop()
        deadline = time.monotonic() + STOP_S
        for _, process in self._running.values():
            while process.poll() is None and time.monotonic() < deadline:
                time.sleep(_POLL_S)
            if process.poll() is None:
                process.kill()


def _returns(found: dict[str, float]) -> str:
    return f", return {', '.join(f'{value:.2f} (p = {p})' for p, value in found.items())}" if found else ""


def _ended(code: int) -> str:
    if code >= 0:
        return f"its process ended with exit code {code}"
    try:
        return f"its process was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"its process was ended by signal {-code}"
