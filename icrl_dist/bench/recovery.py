"""Seconds until a run works again after SIGKILL of a worker, and of the learner with many stored trajectories.

The run is real, with Ray workers and Zenoh.  The size of the dataset on disk relative to its arrays is
measured too.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import statistics
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.bench.training import need_alive, training
from icrl_dist.config.run import ConfigError
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import Refused, StreamKeys, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry.processes import is_learner, is_worker
from icrl_dist.types import Identity

_TASKS = 39  # training tasks of a 7x7 room
_JOB_TASKS = 4


def run(folder: Path = Path("runs"), trajectories: int = 10_000, kills: int = 3) -> dict[str, Any]:
    """Kill a worker ``kills`` times, then the learner after ``trajectories`` are stored.

    ``worker_s``: median seconds until another worker sends the first trajectory of the killed worker's job.
    ``learner_s``: seconds until the learner answers requests again.  Raises ConfigError for numbers that
    are not above 0, RuntimeError if the run ended early.
    """
    if trajectories < 1 or kills < 1:
        raise ConfigError(f"bench recovery: trajectories = {trajectories}, kills = {kills}: must be above 0")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix="recovery-") as scratch:
        out = Path(scratch) / "recovery"
        with training("darkroom-7x7", out, *_settings(trajectories)) as process:
            endpoint = _wait(lambda: _endpoint(out), process)
            with ZenohLink.connect(endpoint, 60.0) as link:
                events = _RunEvents(link, out.name, process)
                waits = [events.kill_a_worker((n + 1) * trajectories // (2 * kills + 2)) for n in range(kills)]
                events.wait_for(trajectories)
                learner_s, stored = _kill_the_learner(process, link, out)
        used = sum(file.stat().st_size for file in (out / "dataset").iterdir())
        store = Dataset(out / "dataset", readonly=True)
        raw = sum(a.nbytes for row in store.index for a in store.read(row.identity).arrays().values())
        found = len(store)
        store.close()
    return {
        "worker_s": round(statistics.median(waits), 3),
        "worker_worst_s": round(max(waits), 3),
        "learner_s": round(learner_s, 2),
        "trajectories": stored,
        "disk_ratio": round(used / raw, 3),
        "bytes_a_trajectory": round(used / found, 1),
    }


def describe(result: dict[str, Any]) -> str:
    """The result in three lines."""
    return (
        f"the job of a killed worker ran again after {result['worker_s']:.2f} s (worst {result['worker_worst_s']:.2f} s)\n"
        f"a killed learner with {result['trajectories']} stored trajectories answered again after {result['learner_s']:.1f} s\n"
        f"the dataset takes {result['disk_ratio']:.3f} times the bytes of its arrays, "
        f"{result['bytes_a_trajectory']:.0f} bytes per trajectory"
    )


class _RunEvents:
    """Events of the run: trajectories that are sent, the number stored, and jobs of workers that ended."""

    def __init__(self, link: ZenohLink, name: str, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._changed = threading.Condition()
        self._stored = 0
        self._sent: list[tuple[float, str, Identity]] = []
        self._freed: list[tuple[str, str]] = []
        link.subscribe(StreamKeys(name).monitor_all, self._on_message)
        threading.Thread(target=self._read_output, daemon=True).start()

    def _on_message(self, key: str, payload: bytes) -> None:
        kind, fields = wire.decode_message(payload)
        with self._changed:
            if kind == "learner":
                self._stored = fields["trajectories"]
            elif kind == "trajectories":
                now = time.monotonic()
                rows = monitor_messages.rows(fields)
                self._sent += [(now, row["worker"], Identity.parse(row["identity"])) for row in rows]
            self._changed.notify_all()

    def _read_output(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if found := re.match(r"worker (\S+) is gone; its job will be leased again: (\S+)", line):
                with self._changed:
                    self._freed.append((found[1], found[2]))
                    self._changed.notify_all()

    def wait_for(self, stored: int) -> None:
        """Wait until this many trajectories are stored."""
        while self._stored < stored:
            need_alive(self._process)
            with self._changed:
                self._changed.wait(0.1)

    def kill_a_worker(self, stored: int) -> float:
        """SIGKILL a worker that holds a job; returns seconds until another worker sends a trajectory of this job."""
        self.wait_for(stored)
        for _ in range(10):
            with self._changed:
                self._freed.clear()
                self._sent.clear()
            children = psutil.Process(self._process.pid).children(recursive=True)
            os.kill(min(child.pid for child in children if is_worker(child)), signal.SIGKILL)
            began = time.monotonic()
            if (moment := self._sent_again()) is not None:
                return moment - began
        raise RuntimeError("ten workers were killed, and none of them held a job; run the benchmark again")

    def _sent_again(self) -> float | None:
        """The time at which a trajectory of the freed job was sent; None if no job was freed."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._freed, 10):
                return None
            dead, label = self._freed[0]
            stage, round_, task = label.split("/")[:3]

            def first_sent() -> float | None:
                job, tasks = (stage, int(round_)), range(int(task), int(task) + _JOB_TASKS)
                sent = (moment for moment, worker, i in self._sent if worker != dead and i[:2] == job and i.task in tasks)
                return next(sent, None)

            if not self._changed.wait_for(lambda: first_sent() is not None, 60):
                raise RuntimeError(f"job {label} of the killed worker {dead} did not run again within 60 s")
            return first_sent()


def _settings(trajectories: int) -> tuple[str, ...]:
    contexts = 2 * trajectories // _TASKS * _TASKS
    return "--method", "dpt", "--stream.job-tasks", str(_JOB_TASKS), "--pretrain.contexts", str(contexts)


def _kill_the_learner(process: subprocess.Popen[str], link: ZenohLink, out: Path) -> tuple[float, int]:
    (learner,) = [child for child in psutil.Process(process.pid).children() if is_learner(child)]
    learner.kill()
    learner.wait(10)
    began = time.monotonic()
    hello = wire.encode_message("ask-nothing", worker="bench")
    while time.monotonic() < began + 120:
        need_alive(process)
        try:
            link.request(StreamKeys(out.name).work, hello, timeout_s=0.5)
        except Refused:  # an answer: the message is unknown to the learner
            break
        except Unanswered:
            time.sleep(0.02)
    answered = time.monotonic() - began
    store = Dataset(out / "dataset", readonly=True)
    try:
        return answered, len(store)
    finally:
        store.close()


def _endpoint(out: Path) -> str:
    with contextlib.suppress(FileNotFoundError):
        return (out / "endpoint").read_text().strip()
    return ""


def _wait(condition: Callable[[], str], process: subprocess.Popen[str]) -> str:
    while not (found := condition()):
        need_alive(process)
        time.sleep(0.05)
    return found
