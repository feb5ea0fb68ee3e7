"""A whole run: its folder, the training, the evaluation and ``result.json``, for the command and for Python."""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from actors import local
from actors.placement import check_cores
from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, load_folder, load_run, override
from icrl_dist.console.display import ReportEvent, Show, reporting
from icrl_dist.launch import train as launch
from icrl_dist.launch.run_folder import FolderTransaction
from icrl_dist.storage.files import hold, write_json
from icrl_dist.storage.fork import parse_source

if TYPE_CHECKING:
    from icrl_dist.results.reports import Evaluation

LOCAL_ACTORS = 2
"""Default number of workers without a cluster."""
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
    overwrite: bool = False,
    progress: Show = False,
) -> TrainResult:
    """Train a method and evaluate it on held-out tasks, as ``icrl-dist train`` does, with the same results.

    ``run``: a ``Run`` (``icrl_dist.load_run``), the name of a packaged run, or the path of a run file; None with
    ``source``: the settings of that run.  ``out``: the run folder; None: runs/NAME of the packaged run or the file.
    ``engine``: ``ray`` for a learner process and Ray workers, ``inline`` for everything in this process.
    ``address``: of a Ray cluster; ``actors``: number of workers, by default 2, on a cluster one for each core;
    ``min_actors``: on a cluster, start with this many after one minute; ``oversubscribe``: allow more workers than cores.
    ``source``: ``"RUN_DIR@ROUND"``, to start from T^ROUND of another run and its data.
    ``resume``: continue the run in the folder; ``overwrite``: replace it.
    ``progress``: True shows it on standard output; a function receives each event, a dictionary.

    Prints nothing without ``progress``.  In the main thread SIGINT and SIGTERM end the run with a checkpoint; the
    former signal handlers are set again at the end.  In another thread they do not reach it.

    Raises ConfigError for impossible settings, for a folder that is in use, and if this process already uses Ray;
    TrainFailed if the run fails, TrainInterrupted if it is interrupted, StoreError if the folder cannot be written, and
    OSError for missing certificates.  The messages name the options of the command line: ``--resume`` is ``resume=True``.
    """
    if run is None and source is None:
        raise ConfigError("train: name a RUN, such as demo, or another run to start from with --from RUN_DIR@ROUND")
    if engine not in get_args(Engine):
        raise ConfigError(f"--engine {engine}: choose one of {', '.join(get_args(Engine))}")
    parent = None if source is None else parse_source(str(source))
    settings = _settings(run, parent)
    folder = _folder(run, out, source)
    for option, value in (("--actors", actors), ("--min-actors", min_actors)):
        if value is not None and value < 1:
            raise ConfigError(f"{option} {value}: at least 1 worker is needed")
    count = LOCAL_ACTORS if actors is None and address is None else actors
    if engine == "ray":
        local.refuse_running_session()
        if address is None and not oversubscribe:
            check_cores(count or LOCAL_ACTORS)
        launch.check_security(settings, address)
    transaction = launch.prepare(settings, folder, resume, overwrite, parent)
    started = time.monotonic()
    with reporting(progress) as show, contextlib.ExitStack() as locks:
        try:
            with transaction:
                report = transaction.commit_at_checkpoint(show)
                if engine == "inline":
                    result = launch.train_inline(settings, folder, report)
                else:
                    result = launch.train_ray(settings, folder, count, address, report, oversubscribe, min_actors)
            locks.enter_context(hold(folder))  # no other command can replace the run during its evaluation
            evaluation = _evaluate(settings, folder, show)
        except launch.TrainInterrupted:
            raise _interrupted(folder, transaction) from None
        result |= {"folder": str(folder), "seconds": round(time.monotonic() - started, 1)}
        result = _final_result(folder, result, evaluation.summary)
        write_json(folder / "result.json", result)
        _record_heldout(settings, folder, evaluation, show)
    return TrainResult(folder, result, evaluation)


def default_folder(run: str | Path, source: str | Path | None = None) -> Path:
    """The run folder of a packaged run or a run file, or of a fork if ``run`` is empty."""
    if Path(run).stem or source is None:
        return Path("runs") / Path(run).stem
    folder, version = parse_source(str(source))
    return Path("runs") / f"{folder.name}-from-{version}"


def _settings(run: Run | str | Path | None, parent: tuple[Path, int] | None) -> Run:
    """The settings to train with, checked as those of a run file are."""
    if isinstance(run, Run):
        return override(run, (), "run")
    if run is not None:
        return load_run(run)
    assert parent is not None, "``train`` refuses a call without both"
    return load_folder(parent[0])


def _folder(run: Run | str | Path | None, out: str | Path | None, source: str | Path | None) -> Path:
    if out is None:
        if isinstance(run, Run) and source is None:
            raise ConfigError("train: a Run has no name; name its run folder, as in out='runs/mine'")
        out = default_folder("" if run is None or isinstance(run, Run) else run, source)
    try:
        return Path(out).expanduser().absolute()
    except RuntimeError as error:
        raise ConfigError(f"--out {out}: {error}") from None


def _evaluate(run: Run, folder: Path, show: ReportEvent) -> Evaluation:
    from icrl_dist.results import heldout, reports  # they import torch, so they come after the training

    if not plugins.find("methods", run.method).trains:
        return reports.experts(heldout.experts(run, folder))
    with launch.interruptible():
        heldout.save_calibrated(folder, show)
        frame = heldout.online(run, folder, folder / "results", show)
    return reports.online(run, folder / "report" / heldout.report_name(run, folder), frame)


def _record_heldout(run: Run, folder: Path, evaluation: Evaluation, show: ReportEvent) -> None:
    from icrl_dist.launch import heldout_metrics  # it imports torch

    heldout_metrics.record(run, folder, evaluation.summary, show)


def _interrupted(folder: Path, transaction: FolderTransaction) -> launch.TrainInterrupted:
    """The exception that says what the folder of an interrupted run holds."""
    if transaction.rolled_back:
        return launch.TrainInterrupted(f"{folder} is as it was before", resumable=False)
    if not folder.exists():
        return launch.TrainInterrupted("nothing had been done yet", resumable=False)
    return launch.TrainInterrupted(f"{folder} holds the checkpoint: resume=True, or --resume, continues from it")


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
