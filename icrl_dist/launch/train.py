"""Running both programs for one run: the learner as a child process, the workers through Ray.

``inline`` runs the same learner and worker in this process over a MemoryLink instead, with
neither Ray nor Zenoh.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import platform
import signal
import threading
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, Run, dumps, load
from icrl_dist.diagnostics.doctor import need_ray_token
from icrl_dist.launch import learner_process, run_folder
from icrl_dist.launch.learner_process import Report, TrainFailed
from icrl_dist.storage.files import atomic_write
from icrl_dist.storage.fork import fork
from icrl_dist.stream import endpoints, security
from icrl_dist.stream.link import StreamKeys


class TrainInterrupted(Exception):  # noqa: N818
    """The run was interrupted; a checkpoint has been written."""


def prepare(run: Run, folder: Path, resume: bool, overwrite: bool, source: tuple[Path, int] | None = None) -> run_folder.Begun:
    """Make the run folder: ``run.toml``, ``env.json``, and with ``source`` what another run's version stands on.

    The run goes on within the returned context, which decides what becomes of a run that is
    overwritten.  Raises ConfigError if the folder cannot be a run's own, if it exists and is neither
    to be resumed nor overwritten, if a run is on in it, or if it is to be resumed with other
    numbers; where its learner listens and is reached may have changed.
    """
    if resume and overwrite:
        raise ConfigError(f"--resume --overwrite: one goes on with the run in {folder}, the other replaces it; leave one out")
    run_folder.check_place(folder, source[0] if source else None)
    try:
        StreamKeys(folder.name)
    except ValueError as error:
        raise ConfigError(f"--out {folder}: {error}") from None
    run_folder.recover(folder)
    begun = run_folder.Begun(folder, source[1] if source and not resume else -1)
    if folder.exists() and not resume and any(folder.iterdir()):
        if not overwrite:
            raise ConfigError(f"{folder} exists: use --resume to go on with it, --overwrite to begin anew, or another --out")
        begun.set_aside()
    try:
        _make(run, folder, resume, source)
    except BaseException:
        begun.restore()
        raise
    return begun


def _make(run: Run, folder: Path, resume: bool, source: tuple[Path, int] | None) -> None:
    file = folder / "run.toml"
    if resume and not file.exists():
        raise ConfigError(f"--resume: {folder} holds no run; leave --resume out to begin one")
    before = load(str(file)) if resume else None
    if before is not None and _elsewhere(before, run) != run:
        raise ConfigError(f"--resume: {file} has other numbers than asked for; resume with the run's own, or use another --out")
    if resume:
        run_folder.take(folder).close()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if source is not None and not resume:
            _fork(*source, run, folder)
        if before is None:
            file.write_text(dumps(run))
        elif before != run:
            began = file.stat()
            atomic_write(file, lambda to: to.write(dumps(run).encode()))
            os.utime(file, ns=(began.st_atime_ns, began.st_mtime_ns))  # when the run began
        atomic_write(folder / "env.json", lambda env: env.write(json.dumps(environment(), indent=1).encode() + b"\n"))
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None


def _elsewhere(run: Run, other: Run) -> Run:
    """The run with the other's places, which are the head's and no part of a result: another head may go on."""
    there = {name: getattr(other.stream, name) for name in ("endpoint", "connect", "certificates")}
    return dataclasses.replace(run, stream=dataclasses.replace(run.stream, **there))


def _fork(theirs: Path, version: int, run: Run, folder: Path) -> None:
    try:
        fork(theirs, version, run, folder)
    except BaseException:
        run_folder.remove(folder)  # it was made just now, and half a fork is no run
        raise


def check_security(run: Run, address: str | None) -> None:
    """Raises LinkError or ConfigError for certificates, or a token of Ray's, that would be missed later."""
    for role in ("learner",) if address else ("learner", "worker"):
        security.files(run.stream.certificates, role)
    if address and not endpoints.parse(run.stream.endpoint).loopback:
        need_ray_token(address)


def environment() -> dict[str, Any]:
    """Versions and machine, as kept in every run folder."""
    names = ("icrl-dist", "numpy", "torch", "ray", "eclipse-zenoh", "msgpack", "gymnasium", "scipy")
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": len(os.sched_getaffinity(0)),
        "versions": {name: metadata.version(name) for name in names},
    }


def train_inline(run: Run, folder: Path, report: Report) -> dict[str, Any]:
    """The whole run in this process, one worker on a thread; returns the learner's result."""
    import torch

    from actors.worker import Worker
    from icrl_dist.stream.memory_link import MemoryHub
    from learner.service import Interrupted, RunFailed, Service

    hub = MemoryHub()
    with hub.link() as ours, hub.link() as theirs:
        try:
            service = Service(run, folder, ours, report)
        except RunFailed as error:
            raise TrainFailed(str(error)) from None
        worker = Worker(theirs, folder.name, "w0")

        def work() -> None:
            torch.set_num_threads(1)
            try:
                worker.run()
            except Exception as error:
                service.fail(RunFailed(f"the worker failed: {error}"))

        thread = threading.Thread(target=work, name="worker", daemon=True)
        with _on_signals(service.stop):
            thread.start()
            try:
                result = service.run()
                service.desk.finish()
                return result
            except Interrupted:
                raise TrainInterrupted from None
            except RunFailed as error:
                raise TrainFailed(str(error)) from None
            finally:
                worker.stop()
                thread.join(timeout=30)
                service.close()


def train_ray(
    run: Run,
    folder: Path,
    actors: int | None,
    address: str | None,
    report: Report,
    oversubscribe: bool = False,
    at_least: int | None = None,
) -> dict[str, Any]:
    """The whole run with a learner process and Ray workers; returns the learner's result.

    Raises ConfigError, TrainFailed or TrainInterrupted; no process is left behind.
    """
    from actors.fleet import Fleet, FleetFailed

    certificates = security.folder(run.stream.certificates)  # in full: workers have a working directory of their own
    interrupted = threading.Event()
    with contextlib.ExitStack() as stack:
        stack.enter_context(_on_signals(interrupted.set))
        if address is None:  # both start at once; on a cluster nothing does before its machines are known to fit
            learner = stack.enter_context(learner_process.running(run, folder))
        note = lambda text: report({"event": "note", "text": text})  # noqa: E731
        with _unmade_if_refused(folder) if address is not None else contextlib.nullcontext():
            try:
                fleet = Fleet(actors, run.learner.restarts, address, oversubscribe, at_least, note, interrupted.is_set)
            except FleetFailed as error:
                raise (TrainInterrupted if interrupted.is_set() else _failed(error)) from None
            stack.callback(fleet.close)
            stack.enter_context(_on_signals(interrupted.set))  # once more: Ray puts its own in their place
            fleet.gather(run.stream.endpoint, run.stream.connect, certificates, note, interrupted.is_set)
            if address is not None and interrupted.is_set():
                raise TrainInterrupted
        if address is not None:
            learner = stack.enter_context(learner_process.running(run, folder))
        result: dict[str, Any] | None = None
        started = False
        stored = given_up = 0
        while True:
            for event in learner.events():
                report(event)
                if event["event"] == "listening" and not started:
                    fleet.start(run.stream.connect or learner.endpoint, folder.name, folder, certificates)
                    started = True
                elif event["event"] == "progress":
                    stored = event["trajectories"]
                elif event["event"] in ("quarantine", "released"):
                    given_up += 1 if event["event"] == "quarantine" else -1
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
                    working = fleet.watch(note, stored + given_up)
                except FleetFailed as error:
                    raise _failed(error) from None
                learner.excuse(fleet.lost)
                if not working:
                    raise TrainFailed("every worker ended before the run did; see learner.log in the run folder")
    if interrupted.is_set():  # while everything was closed
        raise TrainInterrupted
    return {**result, "learner_deaths": learner.deaths, "worker_deaths": fleet.deaths}


def _failed(error: Exception) -> TrainFailed:
    return TrainFailed(f"{error}; the same command with --resume goes on from the last checkpoint")


@contextlib.contextmanager
def _unmade_if_refused(folder: Path) -> Iterator[None]:
    """Removes a run folder in which nothing has happened yet, so that the same command can be given again."""
    try:
        yield
    except (ConfigError, TrainInterrupted):
        if {file.name for file in folder.iterdir()} <= {"run.toml", "env.json"}:
            run_folder.remove(folder)
        raise


def interruptible() -> contextlib.AbstractContextManager[None]:
    """Within it Ctrl-C or a polite kill raises TrainInterrupted: for work that can be done again."""

    def interrupt() -> None:
        raise TrainInterrupted

    return _on_signals(interrupt)


@contextlib.contextmanager
def _on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` instead of dying on Ctrl-C or a polite kill."""
    names = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(name, lambda *_: stop()) for name in names] if _in_main_thread() else []
    try:
        yield
    finally:
        for name, handler in zip(names, before, strict=False):
            signal.signal(name, handler)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
