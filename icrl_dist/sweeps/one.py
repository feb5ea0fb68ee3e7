"""One run of a sweep: its training in this process, its evaluations, its rows; each part that is done is left out.

``python -m icrl_dist.sweeps.one`` does the run that the first line of its standard input describes.  It ends with a
checkpoint at a signal, and when its standard input is closed, because then the sweep has ended.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import signal
import sys
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from icrl_dist.config.run import ConfigError, dumps, parse_written
from icrl_dist.console.signals import interruptible
from icrl_dist.launch import auto, run_folder
from icrl_dist.launch import train as launch
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.methods import budget
from icrl_dist.methods import registry as methods
from icrl_dist.storage.files import RESUME, StoreError, explained, hold, unwritten, write_json
from icrl_dist.stream import schema
from icrl_dist.stream.excerpts import plain
from icrl_dist.sweeps import rows, state
from icrl_dist.sweeps.file import Evaluation
from icrl_dist.sweeps.plan import Member, digest
from icrl_dist.sweeps.state import Meter, State
from icrl_dist.telemetry import provenance

DONE, FAILED, INTERRUPTED = 0, 1, 130
UNWRITTEN = 64
"""Plus the number of an error, such as ENOSPC: exit code of a run that failed and could not write its state for that reason."""
REPEAT = "repeat the command of the sweep"
"""In place of ``--resume``, which a sweep does not have."""

Keep = Literal["all", "weights", "rows"]
"""What is kept of a run that is done: everything, all but the dataset, or only its result rows."""


@dataclass(frozen=True)
class Work:
    """A run of the sweep and how to do it: what the parent sends to the child process."""

    member: Member
    out: Path
    keep: Keep

    def message(self) -> bytes:
        """One line."""
        one = self.member
        evaluations = {name: schema.as_data(evaluation) for name, evaluation in one.evaluations.items()}
        named = {"setting": one.setting, "variant": one.variant, "seed": one.seed, "exact": one.exact}
        found = {**named, "run": dumps(one.run), "evaluations": evaluations, "out": str(self.out), "keep": self.keep}
        return json.dumps(found).encode() + b"\n"

    @classmethod
    def read(cls, message: bytes) -> Work:
        """The inverse of ``message``."""
        found: dict[str, Any] = json.loads(message)
        out, keep = Path(found.pop("out")), found.pop("keep")
        run = parse_written(found.pop("run"), "sweep")
        evaluations = {name: schema.read(Evaluation, _given(one)) for name, one in found.pop("evaluations").items()}
        assert keep in get_args(Keep)
        return cls(Member(run=run, evaluations=evaluations, **found), out, keep)


def _given(evaluation: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in evaluation.items() if value is not None}


def do(work: Work) -> None:
    """Do what is missing of a run.

    Raises ConfigError, TrainFailed, StoreError and TrainInterrupted as ``icrl_dist.train`` does; KeyboardInterrupt for a
    signal during an evaluation.  What was finished before is kept.
    """
    member, folder = work.member, work.member.place(work.out)
    found = state.load(folder)
    state.check(found, member, folder)
    phases = 0 if member.exact else len(methods.of(member.run).phases(member.run))
    meter = Meter(found, folder, 2 * phases + len(member.evaluations))
    found.failed, found.exact = "", member.exact
    try:
        if member.exact:
            found.run = dumps(member.run)
            (folder / "results").mkdir(parents=True, exist_ok=True)
        elif not found.training:
            _train(work, folder, found, meter)
        with interruptible():
            _evaluate(work, folder, found, meter, 2 * phases)
            _free(work, folder, found)
    except BaseException:
        with contextlib.suppress(StoreError):  # it must not hide why the run failed
            meter.save()
        raise
    meter.save()


def _train(work: Work, folder: Path, found: State, meter: Meter) -> None:
    run = auto.without_auto(work.member.run, folder, resume=True, note=lambda text: print(text, flush=True))
    meter.begin("collect", "starting", 0)

    def report(event: dict[str, Any]) -> None:
        meter.event(event)
        if text := event.get("text"):
            print(text, flush=True)

    found.run, found.budget = dumps(run), budget.of(run)._asdict()
    record = provenance.record(run.problem, run.method, run.learner.threads)
    found.versions = {name: record[name] for name in ("package_version", "code_digest", "commit", "libraries")}
    meter.save()  # before the folder has a run: one that no state describes is refused
    with launch.prepare(run, folder, resume=False, overwrite=False, resume_or_begin=True):
        result = launch.train_inline(run, folder, report)
    if result["quarantined"]:
        causes = "; ".join(f"{one['variation']}: {one['cause']}" for one in result["quarantined"])
        raise TrainFailed(f"the training left out variations, so it cannot be compared: {causes}")
    write_json(folder / "result.json", {**result, "folder": str(folder), "seconds": round(found.seconds, 1)})
    found.training = {name: result[name] for name in ("dataset_digest", "weights_digest", "version", "trajectories")}
    meter.save()


def _evaluate(work: Work, folder: Path, found: State, meter: Meter, before: int) -> None:
    """The evaluations that are missing; then the rows of all are collected."""
    from icrl_dist.sweeps import evaluations  # it imports torch, so it comes after the training

    member = work.member
    wanted = {name: digest(member, one) for name, one in member.evaluations.items()}
    with hold(folder):
        for number, (name, evaluation) in enumerate(member.evaluations.items()):
            there = found.evaluations.get(name)
            if there is not None and all((folder / "results" / file).is_file() for file in there["files"]):
                continue
            meter.begin("evaluate", f"evaluation {name}", before + number)
            run = parse_written(found.run, str(folder))
            files = evaluations.do(run, folder, evaluation, member.exact, meter.event)
            found.evaluations[name] = {"settings": wanted[name], "files": files}
            meter.save()
        collected = {name: found.evaluations[name]["files"] for name in wanted}
        table = rows.collect(member, folder / "results", collected, rows.file_of(work.out, member))
    online = (name for name, one in member.evaluations.items() if one.suite == "online")
    found.returns = rows.returns(table, next(online, ""))
    found.collected, found.phase, found.share = list(wanted), "done", 1.0


def _free(work: Work, folder: Path, found: State) -> None:
    """Delete what is not kept of a run that is done.  The state says so first: a kill in between loses nothing."""
    if work.keep == "all":
        return
    found.kept = work.keep
    write_json(state.file_of(folder), vars(found))
    if work.keep == "rows":
        run_folder.remove(folder)
    elif (folder / "dataset").is_dir():
        shutil.rmtree(folder / "dataset")


def main() -> int:
    """Do the run on standard input; its log is on standard output and standard error.  Returns the exit code."""
    work = Work.read(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_the_sweep, name="sweep", daemon=True).start()
    folder = work.member.place(work.out)
    try:
        import torch

        torch.set_num_threads(1)
        do(work)
    except (launch.TrainInterrupted, KeyboardInterrupt):
        return INTERRUPTED
    except Exception as error:
        return _failed(folder, explained(error))
    return DONE


def _failed(folder: Path, cause: Exception) -> int:
    """Write why a run failed into its log and its state.  Returns the exit code."""
    known = isinstance(cause, ConfigError | TrainFailed | StoreError)
    text = plain(" ".join(str(cause).split()), 2_000).replace(RESUME, REPEAT) or type(cause).__name__
    text = text if known else f"{type(cause).__name__}: {text}"
    try:
        if not known:
            traceback.print_exception(cause)
        print(text, flush=True)
    except OSError:  # the log's disk is full; what is left in the buffer would change the exit code
        sys.stdout = sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115
    try:
        found = state.read(folder)
        found.failed = text
        write_json(state.file_of(folder), vars(found))
    except StoreError as error:
        number = getattr(error.__cause__, "errno", None)
        return FAILED if number is None else UNWRITTEN + number
    return FAILED


def ended_unwritten(code: int, folder: Path) -> str:
    """The cause of a run that ended with an exit code of ``UNWRITTEN``; empty for another code."""
    number = code - UNWRITTEN
    if number not in errno.errorcode:
        return ""
    return str(unwritten(state.file_of(folder), OSError(number, os.strerror(number)))).replace(RESUME, REPEAT)


def _end_with_the_sweep() -> None:
    """End this process with a checkpoint when its standard input is closed."""
    while os.read(sys.stdin.fileno(), 1):  # a buffered reader would hold a lock when the process exits
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
