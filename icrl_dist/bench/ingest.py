"""Durable trajectories per second: one worker process, the learner's ingest and store, with and without fsync.

The whole path of a run except training: the worker encodes and sends with credits; the ingest decodes,
checks and appends to the store, and replies after the store has written to disk.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import queue
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.bench.stream import KEYS, LIMIT, example
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import StreamConfig
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import Query
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.types import Job, Spec, Trajectory
from learner.ingest import Ingest

CREDITS = StreamConfig().credits
"""The default of a run."""

IN_MEMORY = ("tmpfs", "ramfs", "devtmpfs")
"""File systems in memory, where an fsync has no effect."""


def work(endpoint: str) -> None:
    """The worker process: request a number of seconds and send for that long, until the number is 0."""
    trajectory, trials = example(), itertools.count()
    with ZenohLink.connect(endpoint, 10.0) as link:
        sender = CreditSender(link, KEYS.data, CREDITS, 10.0)
        while seconds := float(link.request(KEYS.work, b"", 600.0)):
            end = time.monotonic() + seconds
            while True:
                identity = trajectory.identity._replace(trial=next(trials))
                sender.send(wire.encode_trajectory(dataclasses.replace(trajectory, identity=identity)))
                if time.monotonic() > end:
                    break
            sender.drain(60.0)
        sender.close()


def run(folder: Path = Path("runs"), seconds: float = 20.0, pairs: int = 5) -> dict[str, Any]:
    """Measure for ``seconds`` in total, alternating with and without fsync; rates are medians over turns.

    Each turn has its own store, in a temporary folder under ``folder`` that is removed afterwards.
    ``ratio`` is the median over pairs of turns.  Raises ConfigError for a folder on a file system in
    memory, and for a time or a number of pairs that is not above 0.
    """
    if not seconds > 0:
        raise ConfigError(f"bench ingest: seconds = {seconds}: must be above 0")
    if pairs < 1:
        raise ConfigError(f"bench ingest: pairs = {pairs}: must be above 0")
    kind = file_system(folder)
    if kind in IN_MEMORY:
        raise ConfigError(
            f"bench ingest: {folder} is on {kind}, where an fsync has no effect: choose a folder on a disk with --folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    turn = seconds / (2 * pairs)
    with tempfile.TemporaryDirectory(dir=folder, prefix="ingest-") as name, _learner(Path(name)) as learner:
        before = fsync_p50_ms(Path(name))
        learner.turn(turn / 2, durable=True)  # warms the caches
        turns = []
        for pair in range(pairs):
            first = bool(pair % 2)  # the order alternates: during the second turn the disk is still busy with the first
            rates = {durable: learner.turn(turn, durable) for durable in (first, not first)}
            turns.append((rates[True], rates[False]))
        after = fsync_p50_ms(Path(name))
    durable, volatile = (round(statistics.median(column), 1) for column in zip(*turns, strict=True))
    return {
        "durable_per_s": durable,
        "volatile_per_s": volatile,
        "ratio": round(statistics.median(a / b for a, b in turns), 2),
        "file_system": kind,
        "fsync_p50_ms": round((before + after) / 2, 3),
        "trajectories_an_fsync": round(learner.stored / learner.commits, 1),
        "message_bytes": len(wire.encode_trajectory(example())),
        "credits": CREDITS,
        "pairs": [[round(rate, 1) for rate in rates] for rates in turns],
    }


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    rows = [f"{'turn':<8}{'fsynced':>9}{'not':>8}   trajectories/s of {result['message_bytes']} bytes"]
    rows += [f"{i:<8}{a:>9.0f}{b:>8.0f}" for i, (a, b) in enumerate(result["pairs"], 1)]
    rows += [f"{'median':<8}{result['durable_per_s']:>9.0f}{result['volatile_per_s']:>8.0f}"]
    rows += [
        f"with / without fsync: {result['ratio']:.2f}; {result['file_system']}, fsync p50 {result['fsync_p50_ms']:.2f} ms, "
        f"{result['trajectories_an_fsync']:.1f} trajectories per fsync"
    ]
    return "\n".join(rows)


def file_system(folder: Path) -> str:
    """The type of the file system of ``folder``, which need not exist: ``ext4``, ``tmpfs``."""
    path = folder.absolute().resolve()
    mounts = [m for m in psutil.disk_partitions(all=True) if path.is_relative_to(m.mountpoint)]
    # Of two mounts at one path, the later one hides the earlier.
    return max(enumerate(mounts), key=lambda m: (len(Path(m[1].mountpoint).parts), m[0]))[1].fstype if mounts else "unknown"


def fsync_p50_ms(folder: Path, count: int = 60) -> float:
    """Median milliseconds to append the bytes of eight trajectories to a file and fsync it."""
    block, seconds = os.urandom(8 * len(wire.encode_trajectory(example()))), []
    with (folder / "fsync").open("ab") as file:
        for _ in range(count):
            began = time.perf_counter()
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            seconds.append(time.perf_counter() - began)
    return 1e3 * statistics.median(seconds)


class _LearnerSide:
    """The learner's side of the stream: an ingest, and a separate store for every turn."""

    def __init__(self, link: ZenohLink, folder: Path, worker: subprocess.Popen[bytes]) -> None:
        self._folder, self._worker = folder, worker
        self._numbers = itertools.count()
        self._ingest: Ingest | None = None
        self._failure: BaseException | None = None
        self._idle: queue.SimpleQueue[Query] = queue.SimpleQueue()
        self.stored = self.commits = 0
        """Trajectories and fsyncs of the turns with fsync."""
        link.serve(KEYS.data, self._put)
        link.serve(KEYS.work, self._idle.put)
        self._waiting = self._next_request()

    def turn(self, seconds: float, durable: bool) -> float:
        """Trajectories per second into a new store, until the last one sent is stored."""
        folder = self._folder / f"turn-{next(self._numbers)}"
        stored: list[float] = []
        with contextlib.closing(Dataset(folder, durable=durable)) as store:
            self._ingest = ingest = self._open(store, stored)
            began = time.monotonic()
            self._waiting.reply(b"%f" % seconds)
            self._waiting = self._next_request()
            ingest.close()
        shutil.rmtree(folder)  # so that unsynced data is not written to disk during the next turn
        if ingest.drops:
            raise RuntimeError(f"the ingest dropped {dict(ingest.drops)}: the rate would be wrong")
        if durable:
            self.stored += len(stored)
            self.commits += ingest.commits
        return len(stored) / (stored[-1] - began)

    def stop(self) -> None:
        self._waiting.reply(b"0")

    def _open(self, store: Dataset, stored: list[float]) -> Ingest:
        trajectory = example()
        size, actions = trajectory.observations.shape[1], trajectory.labels.shape[1]
        spec = Spec((-9.0,) * size, (9.0,) * size, actions, len(trajectory.actions))
        job = Job("adapt", *trajectory.identity[:3], (trajectory.variation,), 1, trajectory.policy_version, seed=0)

        def note(_: Trajectory) -> None:
            stored.append(time.monotonic())

        return Ingest(store, spec, LIMIT, lambda _: job, lambda _: trajectory.weights_digest, note, self._fail)

    def _put(self, query: Query) -> None:
        assert self._ingest is not None
        self._ingest.put(query)

    def _fail(self, error: BaseException) -> None:
        self._failure = error

    def _next_request(self) -> Query:
        while True:
            try:
                return self._idle.get(timeout=0.1)
            except queue.Empty:
                if self._failure is not None:
                    raise self._failure from None
                if self._worker.poll() is not None:
                    raise RuntimeError(
                        f"the worker process of the benchmark ended: exit code {self._worker.returncode}"
                    ) from None


@contextlib.contextmanager
def _learner(folder: Path) -> Iterator[_LearnerSide]:
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        command = processes.python("-c", "import sys; from icrl_dist.bench.ingest import work; work(sys.argv[1])")
        with subprocess.Popen([*command, link.endpoints[0]], env=processes.environment()) as worker:
            try:
                learner = _LearnerSide(link, folder, worker)
                yield learner
                learner.stop()
                worker.wait(10)
            finally:
                worker.kill()
