"""Runs the learner and the workers of one run: the learner as a child process, the workers through Ray.

``train_inline`` runs the same learner and one worker in this process over a MemoryLink, without Ray
and Zenoh.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, dumps, load_folder
from icrl_dist.console.display import ReportEvent
from icrl_dist.console.signals import on_signals
from icrl_dist.diagnostics.ray_token import require_ray_token
from icrl_dist.launch import learner_process, run_folder, watching
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.launch.run_folder import FolderTransaction
from icrl_dist.storage.files import atomic_write
from icrl_dist.storage.fork import fork
from icrl_dist.stream import endpoints, security
from icrl_dist.stream.link import StreamKeys
from icrl_dist.telemetry import provenance


class TrainInterrupted(Exception):  # noqa: N818
    """The run was interrupted by SIGINT or SIGTERM; the message says what its folder holds now."""

    def __init__(self, text: str = "its checkpoint is written", resumable: bool = True) -> None:
        super().__init__(text)
        self.resumable = resumable
        """Whether the run can be resumed in its folder."""


def prepare(run: Run, folder: Path, resume: bool, overwrite: bool, source: tuple[Path, int] | None = None) -> FolderTransaction:
    """Create or check the run folder: ``run.toml``, ``env.json``, and for a fork the data and weights of ``source``.

    Train within the returned context; it removes or restores a run that is overwritten.  Raises
    ConfigError if the folder cannot be a run folder, if it exists and neither ``resume`` nor
    ``overwrite`` is set, if a run is active in it, or if ``resume`` has other settings than the run.
    Only the endpoints and certificates of the stream may differ, because a resumed run may have
    another head node.
    """
    if resume and overwrite:
        raise ConfigError(f"--resume --overwrite: one continues the run in {folder}, the other replaces it; leave one out")
    run_folder.check_place(folder, source[0] if source else None)
    try:
        StreamKeys(folder.name)
    except ValueError as error:
        raise ConfigError(f"--out {folder}: {error}") from None
    run_folder.recover(folder)
    transaction = FolderTransaction(folder, source[1] if source and not resume else -1)
    if folder.exists() and not resume and any(folder.iterdir()):
        if not overwrite:
            raise ConfigError(f"{folder} exists: use --resume to continue the run, --overwrite to replace it, or another --out")
        transaction.set_aside()
    try:
        _create(run, folder, resume, source)
    except BaseException:
        transaction.roll_back()
        raise
    return transaction


def _create(run: Run, folder: Path, resume: bool, source: tuple[Path, int] | None) -> None:
    file = folder / "run.toml"
    if resume and not file.exists():
        raise ConfigError(f"--resume: {folder} holds no run; leave --resume out to start one")
    before = load_folder(folder) if resume else None
    if before is not None and _with_endpoints_of(before, run) != run:
        raise ConfigError(
            f"--resume: {file} has other settings than this command; resume without overrides, or use another --out"
        )
    if resume:
        run_folder.take(folder).close()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if source is not None and not resume:
            _fork(*source, run, folder)
        if before is None:
            file.write_text(dumps(run))
        elif before != run:
            status = file.stat()
            atomic_write(file, lambda to: to.write(dumps(run).encode()))
            os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))  # its time is the start of the run
        provenance.create(folder)
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None


def _with_endpoints_of(run: Run, other: Run) -> Run:
    """``run`` with the endpoints and certificates of ``other``: they belong to the head node and change no result."""
    fields = {name: getattr(other.stream, name) for name in ("endpoint", "connect", "certificates")}
    return dataclasses.replace(run, stream=dataclasses.replace(run.stream, **fields))


def _fork(source: Path, version: int, run: Run, folder: Path) -> None:
    try:
        fork(source, version, run, folder)
    except BaseException:
        run_folder.remove(folder)  # an incomplete fork is no run
        raise


def check_security(run: Run, address: str | None) -> None:
    """Raise LinkError or ConfigError if a certificate or Ray's token is missing that the run will need."""
    for role in ("learner",) if address else ("learner", "worker"):
        security.files(run.stream.certificates, role)
    if address and not endpoints.parse(run.stream.endpoint).loopback:
        require_ray_token(address)


def train_inline(run: Run, folder: Path, report: ReportEvent) -> dict[str, Any]:
    """Run the learner in this process with one worker on a thread.  Returns the learner's result."""
    import torch

    from actors.worker import Worker
    from icrl_dist.stream.memory_link import MemoryHub
    from learner.service import Interrupted, RunFailed, Service

    hub = MemoryHub()
    with _torch_unchanged(), hub.link() as learner_link, hub.link() as worker_link:
        try:
            service = Service(run, folder, learner_link, report)
        except RunFailed as error:
            raise TrainFailed(str(error)) from None
        worker = Worker(worker_link, folder.name, "w0")

        def work() -> None:
            torch.set_num_threads(1)
            try:
                worker.run()
            except Exception as error:
                service.fail(RunFailed(f"the worker failed: {error}"))

        thread = threading.Thread(target=work, name="worker", daemon=True)
        with on_signals(service.stop):
            thread.start()
            try:
                result = service.run()
                service.worker_api.finish()
                return result
            except Interrupted:
                raise TrainInterrupted from None
            except RunFailed as error:
                raise TrainFailed(str(error)) from None
            finally:
                worker.stop()
                thread.join(timeout=30)
                service.close()


@contextlib.contextmanager
def _torch_unchanged() -> Iterator[None]:
    """Restore what the learner sets in torch for the whole process: its random numbers and its deterministic mode."""
    import torch

    mode = torch.get_deterministic_debug_mode()
    initialized: bool = torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
    with torch.random.fork_rng(range(torch.cuda.device_count()) if initialized else ()):
        try:
            yield
        finally:
            torch.set_deterministic_debug_mode(mode)


def train_ray(
    run: Run,
    folder: Path,
    actors: int | None,
    address: str | None,
    report: ReportEvent,
    oversubscribe: bool = False,
    at_least: int | None = None,
) -> dict[str, Any]:
    """Run a learner process and Ray workers.  Returns the learner's result and how often processes died.

    Raises ConfigError, TrainFailed or TrainInterrupted.  All processes have ended in every case.
    """
    from actors.fleet import Fleet, FleetFailed

    certificates = security.folder(run.stream.certificates)  # an absolute path: workers have another working directory
    interrupted = threading.Event()
    with contextlib.ExitStack() as stack:
        handle_again = stack.enter_context(on_signals(interrupted.set))
        if address is None:  # without a cluster both start at once; on a cluster the nodes are checked first
            learner = stack.enter_context(learner_process.running(run, folder))
        note = lambda text: report({"event": "note", "text": text})  # noqa: E731
        with _remove_if_refused(folder) if address is not None else contextlib.nullcontext():
            try:
                fleet = Fleet(actors, run.learner.restarts, address, oversubscribe, at_least, note, interrupted.is_set)
            except FleetFailed as error:
                raise (TrainInterrupted if interrupted.is_set() else _failed(error)) from None
            except SystemExit:  # raised by Ray's handler of SIGTERM
                raise TrainInterrupted from None
            stack.callback(fleet.close)
            handle_again()  # Ray replaces the handlers
            needed = plugins.of_run(run.problem, run.method)
            fleet.gather(run.stream.endpoint, run.stream.connect, certificates, note, interrupted.is_set, needed)
            if address is not None and interrupted.is_set():
                raise TrainInterrupted
        if address is not None:
            learner = stack.enter_context(learner_process.running(run, folder))
        result: dict[str, Any] | None = None
        started = False
        stored = quarantined = 0
        while True:
            for event in learner.events():
                report(event)
                if event["event"] == "listening" and not started:
                    fleet.start(run.stream.connect or learner.endpoint, folder.name, folder, certificates)
                    started = True
                    report({"event": "note", "text": watching.hint(run.stream, folder, learner.endpoint)})
                elif event["event"] == "progress":
                    stored = event["trajectories"]
                elif event["event"] in ("quarantine", "released"):
                    quarantined += 1 if event["event"] == "quarantine" else -1
                elif event["event"] == "finished":
                    result = {name: value for name, value in event.items() if name != "event"}
            if interrupted.is_set():
                learner.interrupt(report)
                raise TrainInterrupted
            if result is not None:
                break
            learner.watch(report)
            if started:
                try:
                    working = fleet.watch(note, stored + quarantined)
                except FleetFailed as error:
                    raise _failed(error) from None
                learner.excuse(fleet.lost)
                if not working:
                    raise TrainFailed("every worker ended before the run did; the cause is in learner.log in the run folder")
    if interrupted.is_set():  # during the shutdown
        raise TrainInterrupted
    return {**result, "learner_deaths": learner.deaths, "worker_deaths": fleet.deaths}


def _failed(error: Exception) -> TrainFailed:
    return TrainFailed(f"{error}; the same command with --resume continues from the last checkpoint")


@contextlib.contextmanager
def _remove_if_refused(folder: Path) -> Iterator[None]:
    """Remove the run folder if the run was refused before it started, so that the same command can be repeated."""
    try:
        yield
    except (ConfigError, TrainInterrupted):
        if {file.name for file in folder.iterdir()} <= {"run.toml", provenance.FILE}:
            run_folder.remove(folder)
        raise


def interruptible() -> contextlib.AbstractContextManager[object]:
    """A context in which SIGINT and SIGTERM raise TrainInterrupted, for work that can be repeated."""

    def interrupt() -> None:
        raise TrainInterrupted

    return on_signals(interrupt)
