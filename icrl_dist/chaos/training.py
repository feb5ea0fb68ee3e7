"""A training as a process: ``icrl-dist train``, all processes that it starts, and its progress."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil

from icrl_dist.chaos.schedule import Strike
from icrl_dist.config.run import Run
from icrl_dist.methods import registry as methods
from icrl_dist.stream import monitor_messages, security, wire
from icrl_dist.stream.link import LinkError, StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.telemetry.processes import is_learner, is_worker

_POLL_S = 0.02
_LIST_S = 2.0
"""Interval at which child processes are listed, so that all are known when their parent ends, seconds."""


class TrainingFailed(RuntimeError):  # noqa: N818
    """The run ended with an error or did not end; the message says how."""


def gone(process: psutil.Process) -> bool:
    """Whether a process is dead, even if its parent has not read its exit code yet."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    return True


class Training:
    """One ``icrl-dist train``; its terminal output goes to a file beside the run folder."""

    def __init__(self, name: str, run: Run, settings: Sequence[str], folder: Path, actors: int, limit_s: float) -> None:
        """``name`` and ``settings`` are the command's RUN and ``--set``; it is killed after ``limit_s``."""
        self.run, self.folder, self.view, self._limit_s = run, folder, folder, limit_s
        self.prefix: list[str] = []
        """Words before the command, for a run folder that is visible at ``view`` (see ``Disk``)."""
        self.log = folder.with_name(f"{folder.name}.log")
        words = [name, *(word for setting in settings for word in ("--set", setting))]
        self._command = processes.python("-m", "icrl_dist.cli", "train", *words, "--out", str(folder), "--actors", str(actors))
        self._process: subprocess.Popen[bytes] | None = None
        self._seen: set[psutil.Process] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.kill()

    def start(self, *options: str) -> None:
        """Start the command with further options, such as ``--resume``; an earlier one must have ended."""
        with self.log.open("ab") as log:
            command = [*self.prefix, *self._command, *options]
            log.write(f"$ {' '.join(command)}\n".encode())
            log.flush()
            environment = processes.environment()
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=environment)
        self._deadline = time.monotonic() + self._limit_s
        self._listed = 0.0

    @property
    def output(self) -> str:
        """Everything that it has printed, in all starts."""
        return self.log.read_text(errors="replace")

    def ended(self) -> bool:
        """Whether the command has ended.  Raises TrainingFailed after its time limit."""
        assert self._process is not None
        if time.monotonic() - self._listed > _LIST_S:
            self.tree()
        if self._process.poll() is not None:
            return True
        if time.monotonic() > self._deadline:
            raise TrainingFailed(f"the run did not end within {self._limit_s:.0f} s")
        return False

    def wait(self) -> int:
        """Wait for its end and return the exit code.  Raises TrainingFailed as ``ended`` does."""
        assert self._process is not None
        while not self.ended():
            time.sleep(_POLL_S)
        return self._process.returncode

    def result(self) -> dict[str, Any]:
        """Wait for its end and return ``result.json``.  Raises TrainingFailed for an exit code other than 0."""
        code = self.wait()
        if code:
            lines = [line for line in self.output.splitlines() if line.strip()]
            raise TrainingFailed(f"exit code {code}: {lines[-1]}")
        found: dict[str, Any] = json.loads((self.view / "result.json").read_text())
        return found

    def finished(self) -> bool:
        """Whether it has written a result."""
        return (self.view / "result.json").exists()

    def tree(self) -> list[psutil.Process]:
        """Its living processes, parents before children."""
        assert self._process is not None
        self._listed = time.monotonic()
        with contextlib.suppress(psutil.NoSuchProcess):
            root = psutil.Process(self._process.pid)
            found = [root, *root.children(recursive=True)]
            self._seen.update(found)
            return [process for process in found if not gone(process)]
        return []

    def command(self) -> psutil.Process:
        """The process of the command itself."""
        assert self._process is not None
        return psutil.Process(self._process.pid)

    def workers(self) -> list[psutil.Process]:
        """Its worker processes, oldest first."""
        return sorted((p for p in self.tree() if is_worker(p)), key=lambda p: p.create_time())

    def learner(self) -> psutil.Process | None:
        """Its learner process, if there is one."""
        return next((p for p in self.tree() if is_learner(p)), None)

    def group(self) -> list[psutil.Process]:
        """The living processes of its process group: the command, and Ray without the workers."""
        assert self._process is not None
        found = list[psutil.Process]()
        for process in self.tree():
            with contextlib.suppress(ProcessLookupError):
                found += [process] * (os.getpgid(process.pid) == self._process.pid)
        return found

    def signal(self, number: int) -> None:
        """Send a signal to its process group, as a terminal does."""
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def kill(self) -> list[psutil.Process]:
        """SIGKILL all processes at once; returns those that are still alive."""
        if self._process is None:
            return []
        stopped: set[psutil.Process] = set()
        while fresh := set(self.tree()) - stopped:  # stopped processes start no others and react to nothing
            for process in fresh:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.suspend()
            stopped |= fresh
        for process in self._seen:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.wait()
        psutil.wait_procs(self._seen, timeout=10)
        left = [process for process in self._seen if not gone(process)]
        self._seen.clear()
        return left

    def reach(self, strike: Strike) -> str:
        """Wait until the monitor plane shows that the strike is due; the run's progress then, empty if it has ended before."""
        endpoint = self.folder / "endpoint"
        while not (endpoint.exists() and endpoint.read_text().strip()):
            if self.ended():
                return ""
            time.sleep(_POLL_S)
        progress = _ProgressCounter(self.run, strike)
        certificates = security.client(self.run.stream.certificates, "monitor")
        try:
            with ZenohLink.connect(endpoint.read_text().strip(), 30.0, certificates) as link:
                link.subscribe(StreamKeys(self.folder.name).monitor_all, progress.on_message)
                while not progress.due.wait(_POLL_S):
                    if self.ended():
                        return ""
                return progress.where
        except LinkError as error:
            if self.wait() == 0:
                return ""
            raise TrainingFailed(str(error)) from None

    def target(self) -> tuple[str, int] | None:
        """Host and port at which its learner listens, for the proxy."""
        with contextlib.suppress(OSError, ValueError):
            host, _, port = (self.view / "endpoint").read_text().strip().partition("/")[2].rpartition(":")
            return host.strip("[]"), int(port)
        return None

    def segments(self) -> list[Path]:
        """Its segment files, oldest first."""
        return sorted((self.view / "dataset").glob("segment-*.frames"))


class _ProgressCounter:
    """Counts messages of the monitor plane until a strike is due."""

    def __init__(self, run: Run, strike: Strike) -> None:
        self._order = {f"{phase.stage}/{phase.round}": n for n, phase in enumerate(methods.of(run).phases(run))}
        self._strike = strike
        self._counts: Counter[str] = Counter()
        self.where = ""
        self.due = threading.Event()

    def on_message(self, key: str, payload: bytes) -> None:
        """Count one message of the monitor plane."""
        kind, fields = wire.decode_message(payload)
        if kind == "trajectories":
            for one in monitor_messages.rows(fields):
                name = "/".join(one["identity"].split("/")[:2])
                self._counts[name] += 1
                self._check(name, False, self._counts[name])
        elif kind == "learner" and fields["stage"] == "fit":
            self._check(f"{fields['phase']}/{fields['round']}", True, fields["step"])

    def _check(self, name: str, fit: bool, count: int) -> None:
        strike = self._strike
        if not self.due.is_set() and (self._order[name], fit, count) >= (strike.phase, strike.fit, strike.after):
            self.where = f"fit of {name}, step {count}" if fit else f"{name}, {count} trajectories"
            self.due.set()
