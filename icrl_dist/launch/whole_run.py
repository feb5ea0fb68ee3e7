"""A whole run: its folder, the training, the evaluation and ``result.json``, for the command and for Python."""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from actors import local
from actors.placement import check_cores, local_actors
from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, load_folder, load_run, override, run_folder_of
from icrl_dist.console.display import ReportEvent, Show, reporting
from icrl_dist.console.signals import interruptible
from icrl_dist.launch import auto, expert_checks
from icrl_dist.launch import train as launch
from icrl_dist.launch.holdings import holdings, remove_if_empty
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.launch.resuming import place
from icrl_dist.launch.run_folder import FolderTransaction
from icrl_dist.storage.files import hold, without_locks, write_json
from icrl_dist.storage.fork import parse_source
from icrl_dist.stream.schema import as_data
from icrl_dist.telemetry.processes import import_torch

if TYPE_CHECKING:
    from icrl_dist.results.reports import Evaluation

Engine = Literal["ray", "inline"]


@dataclass(frozen=True, eq=False)
class TrainResult:
    """A finished run.  ``load_agent``, ``read_dataset`` and ``read_results`` take its folder."""

    folder: Path
    """The run folder, an absolute path."""
    result: dict[str, Any] = field(repr=False)
    """The content of ``result.json``: digests of dataset and weights, number of trajectories, seconds, and the
    summary of the evaluation."""
    evaluation: Evaluation = field(repr=False)
    """Returns on held-out tasks; for a run of the method ``experts`` those of the experts' recorded episodes."""

    @property
    def quarantined(self) -> list[dict[str, Any]]:
        """The variations that were left out because their jobs ended three workers: ``variation`` and ``cause`` of each."""
        return list(self.result["quarantined"])


def train(
    run: Run | str | Path | None = None,
    out: str | Path | None = None,
    *,
    engine: Engine = "ray",
    address: str | None = None,
    actors: int | None = None,
    min_actors: int | None = None,
    oversubscribe: bool = False,
    source: str | Path | None = None,
    resume: bool = False,
    resume_or_begin: bool = False,
    overwrite: bool = False,
    progress: Show = False,
) -> TrainResult:
    """Train a method and evaluate it on held-out tasks, as ``icrl-dist train`` does, with the same results.

    ``run``: a ``Run`` (``icrl_dist.load_run``), the name of a packaged run, or the path of a run file; None with
    ``source``: the settings of that run.  ``out``: the run folder; None: runs/NAME of the packaged run or the file.
    ``engine``: ``ray`` for a learner process and Ray workers, ``inline`` for everything in this process.
    ``address``: of a Ray cluster; ``actors``: number of workers, by default 2 (1 on a single core), on a cluster one
    for each core;
    ``min_actors``: on a cluster, start with this many after one minute; ``oversubscribe``: allow more workers than cores.
    ``source``: ``"RUN_DIR@ROUND"``, to start from T^ROUND of another run and its data.
    ``resume``: continue the run in the folder; then ``run`` may also be that run folder.  ``resume_or_begin``: the same
    if the folder holds a run, else begin it.  ``overwrite``: replace the run in the folder.
    ``progress``: True shows it on standard output; a function receives each event, a dictionary.

    Prints nothing without ``progress``.  In the main thread the signals of ``console.signals`` (SIGINT, SIGTERM, SIGHUP
    and others) end the run with a checkpoint, unless they were ignored before; the former signal handlers are set again at
    the end.  In another thread they do not reach it.

    Raises ConfigError for impossible settings, for a folder that is in use, and if this process already uses Ray;
    TrainFailed if the run fails, TrainInterrupted if it is interrupted, StoreError if the folder cannot be written, and
    OSError for missing certificates.  The messages name the options of the command line: ``--resume`` is ``resume=True``.
    """
    if run is None and source is None:
        raise ConfigError("train: name a RUN, such as demo, or another run to start from with --from RUN_DIR@ROUND")
    if engine not in get_args(Engine):
        raise ConfigError(f"--engine {engine}: choose one of {', '.join(get_args(Engine))}")
    parent = None if source is None else parse_source(str(source))
    going_on = resume or resume_or_begin
    folder = _folder(run, out, source, going_on)
    settings = _settings(run, parent, going_on)
    for option, value in (("--actors", actors), ("--min-actors", min_actors)):
        if value is not None and value < 1:
            raise ConfigError(f"{option} {value}: at least 1 worker is needed")
    count = local_actors() if actors is None and address is None else actors
    if engine == "ray":
        local.refuse_running_session()
        if address is None and not oversubscribe:
            check_cores(count or 1)
        launch.check_security(settings, address)
    transaction: FolderTransaction | None = None
    try:
        with interruptible(), reporting(progress) as show, contextlib.ExitStack() as locks:
            settings = auto.without_auto(settings, folder, going_on, lambda text: show({"event": "note", "text": text}))
            for note in expert_checks.notes(settings):
                show({"event": "note", "text": note})
            transaction = launch.prepare(settings, folder, resume, overwrite, parent, resume_or_begin)
            started = time.monotonic()
            if warning := without_locks(folder):
                show({"event": "note", "text": warning})
            with transaction:
                report = transaction.commit_at_checkpoint(show)
                if engine == "inline":
                    import_torch()
                    result = launch.train_inline(settings, folder, report)
                else:
                    result = launch.train_ray(settings, folder, count, address, report, oversubscribe, min_actors)
            locks.enter_context(hold(folder))  # no other command can replace the run during its evaluation
            evaluation = _evaluate(settings, folder, show)
            result |= {"folder": str(folder), "seconds": round(time.monotonic() - started, 1)}
            evaluated = {**evaluation.summary, "evaluate": as_data(settings.evaluate)}
            result = _final_result(folder, result, evaluated)
            write_json(folder / "result.json", result)
            _record_heldout(settings, folder, evaluation, show)
    except (launch.TrainInterrupted, KeyboardInterrupt):
        raise _interrupted(folder, transaction) from None
    except TrainFailed as error:
        if transaction is not None and not transaction.rolled_back and (folder / "run.toml").is_file():
            error.add_note(f"resume=True continues the run in {folder}")
        raise
    return TrainResult(folder, result, evaluation)


def _settings(run: Run | str | Path | None, parent: tuple[Path, int] | None, going_on: bool) -> Run:
    """The settings to train with, checked as those of a run file are."""
    if isinstance(run, Run):
        return override(run, (), "run")
    if run is not None:
        folder = run_folder_of(run) if going_on else None
        return load_run(run) if folder is None else load_folder(folder)
    assert parent is not None, "``train`` refuses a call without both"
    return load_folder(parent[0])


def _folder(run: Run | str | Path | None, out: str | Path | None, source: str | Path | None, going_on: bool) -> Path:
    if out is None and isinstance(run, Run) and source is None:
        raise ConfigError("train: a Run has no name; name its run folder, as in out='runs/mine'")
    return place("" if run is None or isinstance(run, Run) else run, out, source, going_on).absolute()


def _evaluate(run: Run, folder: Path, show: ReportEvent) -> Evaluation:
    import_torch()
    from icrl_dist.results import heldout, reports, run_experts  # they import torch, so they come after the training

    if not plugins.find("methods", run.method).trains:
        return reports.experts(heldout.experts(run, folder), run_experts.failures(run))
    heldout.save_calibrated(folder, show)
    frame = heldout.online(run, folder, folder / "results", show)
    return reports.online(run, folder / "report" / heldout.report_name(run, folder), frame)


def _record_heldout(run: Run, folder: Path, evaluation: Evaluation, show: ReportEvent) -> None:
    from icrl_dist.launch import heldout_metrics  # it imports torch

    heldout_metrics.record(run, folder, evaluation.summary, show)


def _interrupted(folder: Path, transaction: FolderTransaction | None) -> launch.TrainInterrupted:
    """The exception that says what the folder of an interrupted run holds."""
    if transaction is not None and transaction.rolled_back:
        return launch.TrainInterrupted(f"{folder} is as it was before", resumable=False)
    if remove_if_empty(folder) or not (folder / "run.toml").is_file():
        return launch.TrainInterrupted("nothing had been done yet", resumable=False)
    kept = holdings(folder)
    if not kept:
        return launch.TrainInterrupted(f"{folder} holds nothing to continue from", resumable=False)
    error = launch.TrainInterrupted(f"resume=True, or --resume, continues from {kept} in {folder}")
    error.kept = kept
    return error


_PRODUCED = ("dataset_digest", "weights_digest", "version", "trajectories")


def _final_result(folder: Path, result: dict[str, Any], evaluation: dict[str, Any]) -> dict[str, Any]:
    """The content of ``result.json``: the result of the training and of the evaluation.

    If a finished run was resumed, the seconds of its first end are kept; if nothing was collected or
    fitted since then, everything but the evaluation is kept.
    """
    try:
        earlier: dict[str, Any] = json.loads((folder / "result.json").read_text())
    except (FileNotFoundError, ValueError):
        return result | evaluation
    if any(earlier.get(name) != result.get(name) for name in _PRODUCED) or result.get("repaired"):
        return result | {"seconds": earlier.get("seconds", result["seconds"])} | evaluation
    return earlier | {"folder": result["folder"]} | evaluation
