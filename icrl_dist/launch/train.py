"""Runs the learner and the workers of one run: the learner as a child process, the workers through Ray.

``train_inline`` runs the same learner and one worker in this process over a MemoryLink, without Ray
and Zenoh.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from actors.running_time import RunningTime
from icrl_dist.config import plugins
from icrl_dist.config.resuming import differences
from icrl_dist.config.run import ConfigError, Run, dumps, load_folder
from icrl_dist.console.display import ReportEvent
from icrl_dist.console.signals import on_signals
from icrl_dist.diagnostics.modules import hidden_packages
from icrl_dist.diagnostics.ray_token import require_ray_token
from icrl_dist.launch import learner_process, run_folder, watching
from icrl_dist.launch.holdings import holdings, remove_if_empty
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.launch.run_folder import FolderTransaction
from icrl_dist.storage import layout
from icrl_dist.storage.files import StoreError, atomic_write
from icrl_dist.storage.fork import fork
from icrl_dist.stream import endpoints, security
from icrl_dist.stream.link import StreamKeys
from icrl_dist.telemetry import provenance

FINISH_S = 10.0
"""Seconds within which the learner's last event arrives after its workers have ended."""


class TrainInterrupted(Exception):  # noqa: N818
    """The run was interrupted by a signal (``console.signals``); the message says what its folder holds now."""

    def __init__(self, text: str = "its checkpoint is written", resumable: bool = True) -> None:
        super().__init__(text)
        self.resumable = resumable
        """Whether the run can be resumed in its folder."""
        self.kept = "the last checkpoint"
        """What it would continue from."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.resumable)


def prepare(
    run: Run,
    folder: Path,
    resume: bool,
    overwrite: bool,
    source: tuple[Path, int] | None = None,
    resume_or_begin: bool = False,
) -> FolderTransaction:
    """Create or check the run folder: ``run.toml``, ``env.json``, and for a fork the data and weights of ``source``.

    ``resume_or_begin``: resume the run in the folder if there is one.  Train within the returned context; it
    removes or restores a run that is overwritten.  Raises ConfigError if the folder cannot be a run folder, if it
    exists and none of the three is set, if two are, if a run is active in it, or if the run that is to be resumed has
    other settings; only those in ``config.resuming.FREE`` may differ.
    """
    flags = {"--resume": resume, "--resume-or-begin": resume_or_begin, "--overwrite": overwrite}
    if sum(flags.values()) > 1:
        named = " ".join(flag for flag, given in flags.items() if given)
        raise ConfigError(f"{named}: these contradict each other about the run in {folder}; give one of them")
    run_folder.check_place(folder, source[0] if source else None)
    try:
        StreamKeys(folder.name)
    except ValueError as error:
        raise ConfigError(f"--out {folder}: {error}") from None
    try:
        layout.refuse_odd_files(folder)
    except StoreError as error:
        raise ConfigError(str(error)) from None
    run_folder.recover(folder)
    resume = resume or (resume_or_begin and (folder / "run.toml").is_file())
    transaction = FolderTransaction(folder, source[1] if source and not resume else -1)
    if folder.exists() and not resume and not run_folder.unused(folder):
        if resume_or_begin:
            run_folder.require_owned(folder)
            raise ConfigError(f"--resume-or-begin: {folder} holds files of a run, but no run.toml: use another --out")
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
    if before is not None and (changed := differences(before, run)):
        named = ", ".join(f"{name} = {old!r} there and {new!r} here" for name, old, new in changed)
        raise ConfigError(
            f"--resume: {file} has other settings than this command: {named}; resume with the values there, "
            f"as `icrl-dist train --resume {folder}` does, or use another --out"
        )
    if resume:
        with run_folder.take(folder):
            layout.sweep(folder)
    try:
        if before is None:
            with run_folder.beginning(folder):
                atomic_write(file, lambda to: to.write(dumps(run).encode()))
                provenance.create(folder)
                if source is not None:
                    _fork(*source, run, folder)
            return
        if before != run:
            status = file.stat()
            atomic_write(file, lambda to: to.write(dumps(run).encode()))
            os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))  # its time is the start of the run
        provenance.create(folder)
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None
    except StoreError as error:
        if not isinstance(error.__cause__, OSError):
            raise
        cause = error.__cause__.strerror
        raise ConfigError(f"--out {folder}: cannot be written ({cause}); choose another folder") from None


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
    """Run the learner in this process with one worker on a thread.  Returns the learner's result.

    Raises ConfigError if a file of the user hides the package ``learner`` in this process.
    An error of ``report`` ends the run like a signal, with a checkpoint, and is raised then.
    """
    import torch

    for name, file in hidden_packages().items():
        raise ConfigError(f"{file} hides the package {name!r}, a part of icrl-dist: rename that file, or use engine 'ray'")

    from actors.worker import Worker
    from icrl_dist.stream.memory_link import MemoryHub
    from learner.service import Interrupted, RunFailed, Service

    hub = MemoryHub()
    service: Service | None = None
    errors: list[BaseException] = []

    def receive(event: dict[str, Any]) -> None:
        if service is None:
            report(event)
        elif not errors:
            try:
                report(event)
            except BaseException as error:
                errors.append(error)
                service.stop()

    with _torch_unchanged(), hub.link() as learner_link, hub.link() as worker_link:
        try:
            service = Service(run, folder, learner_link, receive)
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
            except Interrupted:
                if not errors:
                    raise TrainInterrupted from None
            except RunFailed as error:
                raise TrainFailed(str(error)) from None
            finally:
                worker.stop()
                thread.join(timeout=30)
                service.close()
    if errors:
        raise errors[0]
    return result


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
    with _true_end(folder, interrupted), contextlib.ExitStack() as stack:
        handle_again = stack.enter_context(on_signals(interrupted.set))
        if address is None:  # without a cluster both start at once; on a cluster the nodes are checked first
            learner = stack.enter_context(learner_process.running(run, folder))
        note = lambda text: report({"event": "note", "text": text})  # noqa: E731
        fleet = Fleet(actors, run.learner.restarts, address, oversubscribe, at_least, note, interrupted.is_set)
        stack.callback(fleet.close)
        handle_again()  # Ray replaces the handlers
        needed = plugins.of_run(run.problem, run.method)
        kernel = run.context.decoder == "kernel"
        fleet.gather(run.stream.endpoint, run.stream.connect, certificates, note, interrupted.is_set, needed, kernel)
        if address is not None:
            if interrupted.is_set():
                raise TrainInterrupted
            learner = stack.enter_context(learner_process.running(run, folder))
        result: dict[str, Any] | None = None
        started = False
        stored = quarantined = ray_restarts = 0
        failure: Exception | None = None
        clock, patience_s = RunningTime(), 0.0
        while True:
            for event in learner.events():
                report(event)
                if event["event"] == "listening" and not started:
                    if address is None:
                        learner.end_after_driver(psutil.Process().children(recursive=True))
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
            if result is not None:  # whatever has happened to the workers
                break
            learner.watch(report)
            if failure is not None and clock() >= patience_s:
                raise failure
            if started and failure is None:
                try:
                    if not fleet.watch(note, stored + quarantined):
                        failure = TrainFailed(
                            "every worker ended before the run did; the cause is in learner.log in the run folder"
                        )
                        patience_s = clock() + FINISH_S  # the learner ends its workers when it has finished
                except FleetFailed as error:
                    failure = error
                learner.excuse(fleet.lost)
                if fleet.ray_restarts != ray_restarts:
                    ray_restarts = fleet.ray_restarts
                    learner.end_after_driver(psutil.Process().children(recursive=True))
    if interrupted.is_set():  # during the shutdown
        raise TrainInterrupted
    return {**result, "learner_deaths": learner.deaths, "worker_deaths": fleet.deaths}


@contextlib.contextmanager
def _true_end(folder: Path, interrupted: threading.Event) -> Iterator[None]:
    """Outside the contexts of all processes: say what the folder of a failed run holds, or remove it if that is nothing."""
    from actors.fleet import FleetFailed

    try:
        yield
    except ConfigError:
        remove_if_empty(folder)
        raise
    except FleetFailed as error:
        empty, kept = remove_if_empty(folder), holdings(folder)
        if interrupted.is_set():  # the signal reached Ray's processes too
            raise TrainInterrupted from None
        nothing = f"; nothing has been stored yet{'' if empty else f', see {folder}'}"
        raise TrainFailed(f"{error}{'' if kept else nothing}") from None
