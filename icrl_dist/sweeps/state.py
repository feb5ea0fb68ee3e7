"""The state of each run of a sweep, in the file ``SEED.json`` beside its run folder.

Only the process that does the run writes the file; the sweep reads it, also from other nodes.
"""

from __future__ import annotations

import dataclasses
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from icrl_dist.config.resuming import differences
from icrl_dist.config.run import ConfigError, parse_written
from icrl_dist.storage.files import StoreError, write_json
from icrl_dist.sweeps.file import Evaluation
from icrl_dist.sweeps.plan import Member, digest

_SAVE_S = 2.0
"""Seconds between two writes of progress."""


@dataclass
class State:
    """What is done of one run."""

    run: str = ""
    """The run file with every number, as text; empty before the run began."""
    exact: bool = False
    training: dict[str, Any] = field(default_factory=dict)
    """Of a finished training: digests of dataset and weights, version, trajectories."""
    evaluations: dict[str, dict[str, Any]] = field(default_factory=dict)
    """For each finished evaluation the digest of its ``settings`` and the names of its ``files`` of rows."""
    collected: list[str] = field(default_factory=list)
    """Names of the evaluations whose rows are collected, when the run is done."""
    returns: dict[str, float] = field(default_factory=dict)
    """Mean return of the newest model in the last episode of the first online evaluation, by p."""
    budget: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, Any] = field(default_factory=dict)
    kept: str = "all"
    seconds: float = 0.0
    cpu: dict[str, float] = field(default_factory=dict)
    """CPU-seconds of ``collect``, ``fit`` and ``evaluate``; after a kill those of the last two seconds are missing."""
    phase: str = ""
    share: float = 0.0
    """What the run does now, and which share of it is done, 0 to 1."""
    failed: str = ""
    """Why its last attempt failed, in one line."""

    def done(self, member: Member) -> bool:
        """Whether everything that the sweep file asks for is there, the collected rows included."""
        wanted = {name: digest(member, one) for name, one in member.evaluations.items()}
        there = {name: one["settings"] for name, one in self.evaluations.items()}
        return set(wanted) <= set(self.collected) and all(there.get(name) == value for name, value in wanted.items())


def file_of(folder: Path) -> Path:
    """The state file of a run folder."""
    return folder.with_name(f"{folder.name}.json")


def log_of(folder: Path) -> Path:
    """What the process of a run printed."""
    return folder.with_name(f"{folder.name}.log")


def load(folder: Path) -> State:
    """The state of a run as ``read`` gives it; that of a new run if its folder was deleted."""
    found = read(folder)
    return found if folder.is_dir() or found.kept == "rows" else State()


def read(folder: Path) -> State:
    """What the state file says; that of a new run without one.  Raises StoreError for a damaged file."""
    path = file_of(folder)
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return State(**found)
    except FileNotFoundError:
        return State()
    except (OSError, ValueError, TypeError) as error:
        raise StoreError(f"{path}: not the state of a run ({error}): delete it and the folder {folder}") from None


def check(state: State, member: Member, folder: Path) -> None:
    """Raises ConfigError if the run that exists has other settings than the sweep file gives it."""
    remedy = f"use another --out, or delete {file_of(folder) if state.kept == 'rows' else folder}"
    if state.run:
        if state.exact != member.exact:
            here, there = ("has" if exact else "has not" for exact in (member.exact, state.exact))
            raise ConfigError(f"{folder}: the run there {there} method 'exact', and the one in the sweep file {here}; {remedy}")
        before = parse_written(state.run, str(file_of(folder)))
        if changed := differences(before, member.run):
            named = ", ".join(f"{name} = {old!r} there and {new!r} here" for name, old, new in changed)
            raise ConfigError(f"{folder}: the run there has other settings: {named}; {remedy}")
    for name, evaluation in member.evaluations.items():
        _check_evaluation(state, member, name, evaluation, folder, remedy)


def _check_evaluation(state: State, member: Member, name: str, evaluation: Evaluation, folder: Path, remedy: str) -> None:
    before = state.evaluations.get(name)
    if before is None:
        if state.kept == "rows" and state.collected:
            raise ConfigError(f"{folder}: evaluation {name} is new, and --keep rows has deleted the weights; {remedy}")
    elif before["settings"] != digest(member, evaluation):
        raise ConfigError(f"{folder}: evaluation {name} there has other settings; give this one another name, or {remedy}")


class Meter:
    """Writes a run's progress, its seconds and its CPU-seconds into the state file."""

    def __init__(self, state: State, folder: Path, stages: int) -> None:
        """``stages``: of the whole run: collections, fits and evaluations."""
        self._state, self._file, self._stages = state, file_of(folder), stages
        self._wall, self._cpu, self._saved = time.monotonic(), time.process_time(), 0.0
        self._stage, self._finished = "collect", 0
        self._name: tuple[object, ...] = ()

    def event(self, event: dict[str, Any]) -> None:
        """Take in an event of the training or of an evaluation."""
        if event["event"] != "progress":
            return
        name = (event["stage"], event.get("phase"), event.get("round"))
        if name != self._name and self._name and event["stage"] != "evaluate":
            self._finished += 1
        self._name = name
        self._account()
        self._stage = event["stage"]
        step, steps = event["step"], event["steps"]
        self._show(f"{_place(event)} {step}/{steps}", step / steps if steps else 0.0)

    def begin(self, stage: str, text: str, finished: int) -> None:
        """A stage begins before its first event; ``finished``: number of stages before it."""
        self._account()
        self._stage, self._finished, self._name = stage, finished, ()
        self._show(text, 0.0)

    def save(self) -> None:
        """Write the state file now."""
        self._account()
        write_json(self._file, dataclasses.asdict(self._state))
        self._saved = time.monotonic()

    def _show(self, text: str, share: float) -> None:
        self._state.phase = text
        self._state.share = min(1.0, (self._finished + share) / max(self._stages, 1))
        if time.monotonic() - self._saved >= _SAVE_S:
            self.save()

    def _account(self) -> None:
        wall, cpu = time.monotonic(), time.process_time()
        self._state.seconds += wall - self._wall
        self._state.cpu[self._stage] = self._state.cpu.get(self._stage, 0.0) + cpu - self._cpu
        self._wall, self._cpu = wall, cpu


def _place(event: dict[str, Any]) -> str:
    if event["stage"] == "evaluate":
        return str(event["phase"])
    return f"{event['phase']}/{event['round']} {event['stage']}"
