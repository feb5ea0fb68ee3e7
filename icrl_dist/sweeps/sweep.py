"""A whole sweep, for the command and for Python."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, get_args

from icrl_dist.config.paths import path_of
from icrl_dist.config.run import ConfigError
from icrl_dist.console.display import Show, reporting
from icrl_dist.console.signals import on_signals
from icrl_dist.console.stage_rows import duration
from icrl_dist.launch import run_folder
from icrl_dist.launch.train import TrainInterrupted
from icrl_dist.methods import budget
from icrl_dist.storage.files import RESUME, StoreError, explained, hold, write_json
from icrl_dist.sweeps import file as sweep_file
from icrl_dist.sweeps import plan, rows, state
from icrl_dist.sweeps.execute import Execution
from icrl_dist.sweeps.file import SweepFile
from icrl_dist.sweeps.one import REPEAT, Keep
from icrl_dist.sweeps.plan import Member
from icrl_dist.sweeps.processes import COMMAND, ENVIRONMENT, Child, Start
from icrl_dist.sweeps.state import State

MARK = "sweep.json"
"""The file of a folder that holds a sweep: the sweep's name and base run."""


@dataclass(frozen=True)
class Plan:
    """The runs of a sweep and their states, before anything is done."""

    name: str
    source: Path
    out: Path
    file: SweepFile = field(repr=False)
    every: tuple[Member, ...] = field(repr=False)
    """All runs of the file."""
    chosen: tuple[Member, ...] = field(repr=False)
    """Those that were asked for."""
    states: dict[str, State] = field(repr=False)
    """Of all runs, by name."""


@dataclass(frozen=True)
class SweepResult:
    """A sweep after it ended."""

    out: Path
    """Its folder.  ``rows.parquet`` there has the rows of all runs that are done."""
    runs: list[dict[str, Any]] = field(repr=False)
    """What ``runs.json`` has of each run: digests, seconds, CPU-seconds, budgets, versions."""
    failed: list[dict[str, str]]
    """``run``, ``cause`` and ``log`` of each run that failed."""
    summary: dict[str, Any] = field(repr=False)
    """What ``icrl-dist sweep --json`` prints."""


def make_plan(
    file: str | Path,
    out: str | Path | None = None,
    only: Sequence[str] = (),
    settings: Sequence[str] = (),
    seeds: Sequence[int] = (),
) -> Plan:
    """Read a sweep file and compare it with what is there.  Writes nothing.

    Raises ConfigError for a wrong file, for methods that are no fair comparison, for a folder of another sweep, and for
    runs there with other settings.
    """
    source = path_of("FILE", file)
    found = sweep_file.read(source)
    every = plan.members(found, source)
    plan.check_equal(every, found, str(source))
    chosen = plan.chosen(every, only, settings, seeds)
    folder = (Path("runs") / source.stem if out is None else path_of("--out", out)).expanduser().absolute()
    run_folder.check_place(folder)
    _check_folder(folder, source.stem, found.run)
    states = {one.name: state.load(one.place(folder)) for one in every}
    for one in every:
        state.check(states[one.name], one, one.place(folder))
        if not states[one.name].run and (one.place(folder) / "run.toml").exists():
            raise ConfigError(f"{one.place(folder)}: holds a run that no sweep began; use another --out, or delete that folder")
    return Plan(source.stem, source, folder, found, every, chosen, states)


def sweep(
    file: str | Path,
    out: str | Path | None = None,
    *,
    only: Sequence[str] = (),
    settings: Sequence[str] = (),
    seeds: Sequence[int] = (),
    jobs: int | None = None,
    address: str | None = None,
    keep: Keep = "weights",
    progress: Show = False,
) -> SweepResult:
    """Train and evaluate every run of a sweep file that is not done yet, as ``icrl-dist sweep`` does.

    ``file``: the sweep file (docs/sweeps.md).  ``out``: the sweep's folder; None: runs/NAME of the file.
    ``only``, ``settings``, ``seeds``: limit it to these methods, settings and training seeds of the file.
    ``jobs``: runs at a time, by default one for each core.  ``address``: of a Ray cluster whose nodes share the folder.
    ``keep``: what is kept of a run that is done: ``all``, ``weights`` (all but the dataset), or only its result ``rows``.
    ``progress``: True shows it on standard output; a function receives each event, a dictionary.

    Each run is done in a process of its own.  One that fails is listed in ``failed`` of the result, and the others go on.
    A repetition does only what is missing.

    Raises ConfigError for a wrong file, before anything is written; TrainInterrupted after a signal, when all runs have
    written their checkpoints; StoreError if the folder cannot be written.
    """
    if keep not in get_args(Keep):
        raise ConfigError(f"--keep {keep}: choose one of {', '.join(get_args(Keep))}")
    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs {jobs}: at least 1 run at a time")
    made = make_plan(file, out, only, settings, seeds)
    began, stop = time.monotonic(), threading.Event()
    with (
        _with_own_remedy(),
        on_signals(stop.set),
        reporting(progress) as show,
        _locked(made),
        contextlib.ExitStack() as stack,
    ):
        missing = [one for one in made.chosen if not _finished(made, one)]
        start, cores = _starter(address, made.out, stack) if missing else (Child, 1)
        execution = Execution(missing, len(made.chosen) - len(missing), made.out, keep, jobs or cores, start)
        ended = execution.run(show, stop.is_set)
        runs, count = _gather(made, show)
    if not ended:
        raise TrainInterrupted(f"repeat the command: it continues the runs in {made.out}")
    failed = [{"run": one.member.name, "cause": one.cause, "log": str(one.log)} for one in execution.failures]
    done = [one["run"] for one in runs]
    summary = {
        "out": str(made.out),
        "runs": len(made.chosen),
        "done": sum(one.name in done for one in made.chosen),
        "failed": failed,
        "rows": count,
        "seconds": round(time.monotonic() - began, 1),
        "cpu_seconds": round(sum(sum(one["cpu_seconds"].values()) for one in runs), 1),
    }
    return SweepResult(made.out, runs, failed, summary)


@contextlib.contextmanager
def _with_own_remedy() -> Iterator[None]:
    """Errors of files name the command of the sweep, which has no ``--resume``."""
    try:
        yield
    except Exception as error:
        if RESUME not in str(cause := explained(error)):
            raise
        raise StoreError(str(cause).replace(RESUME, REPEAT)) from error


def _finished(made: Plan, member: Member) -> bool:
    return made.states[member.name].done(member) and rows.file_of(made.out, member).is_file()


def _check_folder(folder: Path, name: str, run: str) -> None:
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    mark = _mark(folder)
    if mark is None:
        raise ConfigError(f"--out {folder}: holds other files and no sweep; use another --out")
    if mark and mark != {"name": name, "run": run}:
        there = f"the sweep {mark.get('name')} of run {mark.get('run')}"
        raise ConfigError(f"--out {folder}: holds another sweep ({there}); use another --out")


def _mark(folder: Path) -> dict[str, Any] | None:
    """What the folder says of its sweep: nothing if it was killed before it began; None for a folder without a sweep."""
    try:
        found: dict[str, Any] = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {} if {path.name for path in folder.iterdir()} <= {".lock"} else None
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / MARK}: cannot be read ({error}); use another --out") from None
    return found


@contextlib.contextmanager
def _locked(made: Plan) -> Iterator[None]:
    """The folder of the sweep is made and locked within this context."""
    try:
        made.out.mkdir(parents=True, exist_ok=True)
        lock: IO[bytes] = hold(made.out, 0.0)
    except StoreError:
        raise ConfigError(f"--out {made.out}: another command does a sweep in this folder; wait for it, or end it") from None
    except OSError as error:
        raise ConfigError(f"--out {made.out}: cannot be written ({error.strerror}); choose another folder") from None
    with lock:
        write_json(made.out / MARK, {"name": made.name, "run": made.file.run})
        yield


def _starter(address: str | None, out: Path, stack: contextlib.ExitStack) -> tuple[Start, int]:
    """What starts the processes of runs, and how many run at a time by default."""
    if address is None:
        return Child, len(os.sched_getaffinity(0))
    from actors import fleet, tasks

    ray = stack.enter_context(fleet.connected(address))

    def start(message: bytes, log: Path) -> tasks.Task:
        return tasks.start(ray, COMMAND, ENVIRONMENT, message, log)

    return start, max(1, int(ray.cluster_resources().get("CPU", 1)))


def _gather(made: Plan, show: Any) -> tuple[list[dict[str, Any]], int]:
    """Write ``runs.json`` and ``rows.parquet`` of all runs of the file that are done."""
    runs, files = [], []
    for one in sorted(made.every, key=lambda one: (one.setting, one.variant, one.seed)):
        found = state.load(one.place(made.out))
        file = rows.file_of(made.out, one)
        if found.done(one) and file.is_file():
            files.append(file)
            runs.append(_described(one, found))
    count = rows.join(files, made.out / "rows.parquet")
    write_json(made.out / "runs.json", runs)  # after the rows: a damaged file leaves both as they were
    return runs, count


def _described(member: Member, found: State) -> dict[str, Any]:
    named = {"run": member.name, "setting": member.setting, "variant": member.variant, "seed": member.seed}
    labels = None if member.exact else budget.label_bytes(member.run)
    return {
        **named,
        **{name: found.training.get(name) for name in ("dataset_digest", "weights_digest")},
        "returns": found.returns,
        "budget": found.budget,
        **{name: None if labels is None else getattr(labels, name) for name in budget.LabelBytes._fields},
        "seconds": round(found.seconds, 2),
        "cpu_seconds": {name: round(value, 2) for name, value in found.cpu.items()},
        "kept": found.kept,
        "versions": found.versions,
        "evaluations": {name: one["settings"] for name, one in found.evaluations.items()},
    }


def describe(made: Plan) -> list[str]:
    """The list of runs with their budgets, what is done, and the time of the rest where other runs have shown it."""
    lines, known = [], [found for found in made.states.values() if found.collected]
    every = [sum(found.cpu.values()) for found in known]
    alone = {(one.setting, one.variant): one for one in made.chosen}  # a budget does not depend on the seed
    costs = {key: "no training" if one.exact else _budget(one) for key, one in alone.items()}
    seconds, unknown = 0.0, 0
    for one in made.chosen:
        found = made.states[one.name]
        if _finished(made, one):
            what = "done"
        else:
            what = f"{found.share:.0%} done" if found.run else "missing"
            alike = [sum(made.states[other.name].cpu.values()) for other in made.every if _like(made, one, other)]
            unknown += not (alike or every)
            seconds += (1 - found.share) * sum(alike or every) / max(len(alike or every), 1)
        cost = costs[one.setting, one.variant]
        lines.append(f"{one.name}  {what}  {cost}; evaluations: {', '.join(one.evaluations) or 'none'}")
    missing = sum(not _finished(made, one) for one in made.chosen)
    text = f"{len(made.chosen)} runs, {missing} of them missing, in {made.out}"
    if missing and not unknown:
        text += f"; about {duration(seconds)} of CPU time, from the runs that are done"
    return [*lines, text]


def _like(made: Plan, one: Member, other: Member) -> bool:
    return (one.setting, one.variant) == (other.setting, other.variant) and _finished(made, other)


def _budget(member: Member) -> str:
    found = budget.of(member.run)._asdict()
    extra = f" (and {found['extra_steps']} of other nets)" if found["extra_steps"] else ""
    return ", ".join(f"{found[name]} {budget.COMPARED[name]}" for name in plan.QUANTITIES if found[name] is not None) + extra
