"""A training under observation: ``icrl-dist train`` as a process, all that it starts, and how far it is."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
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
from icrl_dist.methods.recipes import METHODS
from icrl_dist.stream import monitor_messages, security, wire
from icrl_dist.stream.link import LinkError, StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry.processes import is_learner, is_worker

_POLL_S = 0.02
_LOOK_S = 2.0
"""The tree is looked at so often, so that none of it is lost sight of when its parent ends."""


class Broken(RuntimeError):  # noqa: N818
    """The run did not end as it should have; the message says how."""


def gone(process: psutil.Process) -> bool:
    """Whether a process is dead, even if nobody has asked for its exit code yet."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    return True


class Training:
    """One ``icrl-dist train``; its terminal output goes to a file beside the run folder."""

    def __init__(self, name: str, run: Run, settings: Sequence[str], folder: Path, actors: int, limit_s: float) -> None:
        """``name`` and ``settings`` are the command's RUN and ``--set``; it is ended after ``limit_s``."""
        self.run, self.folder, self.view, self._limit_s = run, folder, folder, limit_s
        self.prefix: list[str] = []
        """What the command is started with, if its files are to be seen elsewhere (``view``)."""
        self.log = folder.with_name(f"{folder.name}.log")
        words = [name, *(word for setting in settings for word in ("--set", setting))]
        self._command = [sys.executable, "-m", "icrl_dist.cli", "train", *words, "--out", str(folder), "--actors", str(actors)]
        self._process: subprocess.Popen[bytes] | None = None
        self._seen: set[psutil.Process] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.kill()

    def start(self, *options: str) -> None:
        """Start it, as with ``--resume``; once the one before has ended."""
        with self.log.open("ab") as log:
            command = [*self.prefix, *self._command, *options]
            log.write(f"$ {' '.join(command)}\n".encode())
            log.flush()
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        self._deadline = time.monotonic() + self._limit_s
        self._looked = 0.0

    @property
    def output(self) -> str:
        """All that it printed so far, in all of its lives."""
        return self.log.read_text(errors="replace")

    def ended(self) -> bool:
        """Whether it is over.  Raises Broken when it takes longer than its limit."""
        assert self._process is not None
        if time.monotonic() - self._looked > _LOOK_S:
            self.tree()
        if self._process.poll() is not None:
            return True
        if time.monotonic() > self._deadline:
            raise Broken(f"the run did not end within {self._limit_s:.0f} s")
        return False

    def wait(self) -> int:
        """Its exit code, once it has ended.  Raises Broken as ``ended`` does."""
        assert self._process is not None
        while not self.ended():
            time.sleep(_POLL_S)
        return self._process.returncode

    def result(self) -> dict[str, Any]:
        """Wait for its end; what it left in ``result.json``.  Raises Broken unless it ended well."""
        code = self.wait()
        if code:
            words = [line for line in self.output.splitlines() if line.strip()]
            raise Broken(f"exit code {code}: {words[-1]}")
        found: dict[str, Any] = json.loads((self.view / "result.json").read_text())
        return found

    def finished(self) -> bool:
        """Whether it left a result."""
        return (self.view / "result.json").exists()

    def tree(self) -> list[psutil.Process]:
        """Every process of it, parents before children."""
        assert self._process is not None
        self._looked = time.monotonic()
        with contextlib.suppress(psutil.NoSuchProcess):
            root = psutil.Process(self._process.pid)
            found = [root, *root.children(recursive=True)]
            self._seen.update(found)
            return [process for process in found if not gone(process)]
        return []

    def workers(self) -> list[psutil.Process]:
        """The workers' processes, by age."""
        return sorted((p for p in self.tree() if is_worker(p)), key=lambda p: p.create_time())

    def learner(self) -> psutil.Process | None:
        """The learner's process, if there is one."""
        return next((p for p in self.tree() if is_learner(p)), None)

    def kill(self) -> list[psutil.Process]:
        """SIGKILL everything at one stroke; returns what is left of it."""
        if self._process is None:
            return []
        stopped: set[psutil.Process] = set()
        while fresh := set(self.tree()) - stopped:  # nobody starts anybody, nor notices, meanwhile
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
        """Wait until the strike is due, as heard on the monitor plane; where the run is then, empty if it ended before."""
        endpoint = self.folder / "endpoint"
        while not (endpoint.exists() and endpoint.read_text().strip()):
            if self.ended():
                return ""
            time.sleep(_POLL_S)
        ear = _Ear(self.run, strike)
        certificates = security.client(self.run.stream.certificates, "monitor")
        try:
            with ZenohLink.connect(endpoint.read_text().strip(), 30.0, certificates) as link:
                link.subscribe(StreamKeys(self.folder.name).monitor_all, ear.hear)
                while not ear.due.wait(_POLL_S):
                    if self.ended():
                        return ""
                return ear.where
        except LinkError as error:
            if self.wait() == 0:
                return ""
            raise Broken(str(error)) from None

    def target(self) -> tuple[str, int] | None:
        """Where its learner listens now, for a proxy."""
        with contextlib.suppress(OSError, ValueError):
            host, _, port = (self.view / "endpoint").read_text().strip().partition("/")[2].rpartition(":")
            return host.strip("[]"), int(port)
        return None

    def segments(self) -> list[Path]:
        """Its sealed segments and the newest one, oldest first."""
        return sorted((self.view / "dataset").glob("segment-*.frames"))


class _Ear:
    """Counts what the monitor plane tells, until a strike is due."""

    def __init__(self, run: Run, strike: Strike) -> None:
        self._order = {f"{phase.stage}/{phase.round}": n for n, phase in enumerate(METHODS[run.method].phases(run))}
        self._strike = strike
        self._heard: Counter[str] = Counter()
        self.where = ""
        self.due = threading.Event()

    def hear(self, key: str, payload: bytes) -> None:
        """One message of the monitor plane."""
        kind, fields = wire.decode_message(payload)
        if kind == "trajectories":
            for one in monitor_messages.rows(fields):
                name = "/".join(one["identity"].split("/")[:2])
                self._heard[name] += 1
                self._note(name, False, self._heard[name])
        elif kind == "learner" and fields["stage"] == "fit":
            self._note(f"{fields['phase']}/{fields['round']}", True, fields["step"])

    def _note(self, name: str, fit: bool, count: int) -> None:
        strike = self._strike
        if not self.due.is_set() and (self._order[name], fit, count) >= (strike.phase, strike.fit, strike.after):
            self.where = f"fit of {name}, step {count}" if fit else f"{name}, {count} heard"
            self.due.set()
