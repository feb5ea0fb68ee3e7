"""Durable trajectories a second: one worker process, the learner's own inbox and store, with and without fsync.

Everything of a run but the learning: the worker encodes and sends on credit, the inbox decodes,
checks, appends to the store, and answers once the store says that it is on disk.
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
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.bench.stream import KEYS, LIMIT, example
from icrl_dist.config.run import ConfigError, StreamConfig
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import Query
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Job, Spec, Trajectory
from learner.ingest import Inbox

CREDITS = StreamConfig().credits
"""A run's own default."""

IN_MEMORY = ("tmpfs", "ramfs", "devtmpfs")
"""File systems on which an fsync does nothing."""


def work(endpoint: str) -> None:
    """The worker process: ask for seconds of work, send for so long, until told to send for none."""
    one, trials = example(), itertools.count()
    with ZenohLink.connect(endpoint, 10.0) as link:
        sender = CreditSender(link, KEYS.data, CREDITS, 10.0)
        while seconds := float(link.request(KEYS.work, b"", 600.0)):
            end = time.monotonic() + seconds
            while True:
                identity = one.identity._replace(trial=next(trials))
                sender.send(wire.encode_trajectory(dataclasses.replace(one, identity=identity)))
                if time.monotonic() > end:
                    break
            sender.drain(60.0)
        sender.close()


def run(folder: Path = Path("runs"), seconds: float = 20.0, pairs: int = 5) -> dict[str, Any]:
    """Measure for ``seconds`` in all, with and without fsync by turns; medians over the turns.

    Each turn has a store of its own, in a temporary folder under ``folder`` that is removed
    afterwards.  ``ratio`` is the median over pairs of turns.  Raises ConfigError for a folder
    whose file system is in memory, and for a time or a number of pairs that is not above 0.
    """
    if not seconds > 0:
        raise ConfigError(f"bench ingest: seconds = {seconds}: must be above 0")
    if pairs < 1:
        raise ConfigError(f"bench ingest: pairs = {pairs}: must be above 0")
    kind = file_system(folder)
    if kind in IN_MEMORY:
        raise ConfigError(
            f"bench ingest: {folder} lies on {kind}, where an fsync does nothing: name a folder on a disk by --folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    turn = seconds / (2 * pairs)
    with tempfile.TemporaryDirectory(dir=folder, prefix="ingest-") as name, _learner(Path(name)) as learner:
        before = fsync_p50_ms(Path(name))
        learner.turn(turn / 2, durable=True)  # finds cold caches
        turns = []
        for pair in range(pairs):
            first = bool(pair % 2)  # what comes second finds the disk busy with the first's bytes, so they change places
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
        f"{result['trajectories_an_fsync']:.1f} trajectories each"
    ]
    return "\n".join(rows)


def file_system(folder: Path) -> str:
    """The name of the file system that ``folder`` lies on, or would: ``ext4``, ``tmpfs``."""
    where = folder.absolute().resolve()
    mounts = [m for m in psutil.disk_partitions(all=True) if where.is_relative_to(m.mountpoint)]
    # Of two mounts in one place, the later one covers the earlier.
    return max(enumerate(mounts), key=lambda m: (len(Path(m[1].mountpoint).parts), m[0]))[1].fstype if mounts else "unknown"


def fsync_p50_ms(folder: Path, count: int = 60) -> float:
    """Median of what it takes to append eight trajectories' bytes to a file and fsync it, milliseconds."""
    block, taken = os.urandom(8 * len(wire.encode_trajectory(example()))), []
    with (folder / "fsync").open("ab") as file:
        for _ in range(count):
            began = time.perf_counter()
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            taken.append(time.perf_counter() - began)
    return 1e3 * statistics.median(taken)


class _Learner:
    """The learner's side of the stream: an inbox, and a store of its own for every turn."""

    def __init__(self, link: ZenohLink, folder: Path, worker: subprocess.Popen[bytes]) -> None:
        self._folder, self._worker = folder, worker
        self._numbers = itertools.count()
        self._inbox: Inbox | None = None
        self._failure: BaseException | None = None
        self._idle: queue.SimpleQueue[Query] = queue.SimpleQueue()
        self.stored = self.commits = 0
        """Trajectories of the turns with fsync, and how many fsyncs they took."""
        link.serve(KEYS.data, self._put)
        link.serve(KEYS.work, self._idle.put)
        self._waiting = self._next_request()

    def turn(self, seconds: float, durable: bool) -> float:
        """Trajectories a second into a fresh store, until the last one that was sent is stored."""
        folder = self._folder / f"turn-{next(self._numbers)}"
        stored: list[float] = []
        with contextlib.closing(Dataset(folder, durable=durable)) as store:
            self._inbox = inbox = self._open(store, stored)
            began = time.monotonic()
            self._waiting.reply(b"%f" % seconds)
            self._waiting = self._next_request()
            inbox.close()
        shutil.rmtree(folder)  # what was not fsynced need not be written either, in the next one's time
        if inbox.drops:
            raise RuntimeError(f"the inbox dropped {dict(inbox.drops)}: this measures nothing")
        if durable:
            self.stored += len(stored)
            self.commits += inbox.commits
        return len(stored) / (stored[-1] - began)

    def stop(self) -> None:
        self._waiting.reply(b"0")

    def _open(self, store: Dataset, stored: list[float]) -> Inbox:
        one = example()
        size, actions = one.observations.shape[1], one.labels.shape[1]
        spec = Spec((0.0,) * size, (1.0,) * size, actions, len(one.actions))
        job = Job("adapt", *one.identity[:3], (one.variation,), 1, one.policy_version, seed=0)

        def note(_: Trajectory) -> None:
            stored.append(time.monotonic())

        return Inbox(store, spec, LIMIT, lambda _: job, lambda _: one.weights_digest, note, self._fail)

    def _put(self, query: Query) -> None:
        assert self._inbox is not None
        self._inbox.put(query)

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
                    raise RuntimeError(f"the bench's worker process died: exit code {self._worker.returncode}") from None


@contextlib.contextmanager
def _learner(folder: Path) -> Iterator[_Learner]:
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        command = [sys.executable, "-c", "import sys; from icrl_dist.bench.ingest import work; work(sys.argv[1])"]
        with subprocess.Popen([*command, link.endpoints[0]]) as worker:
            try:
                learner = _Learner(link, folder, worker)
                yield learner
                learner.stop()
                worker.wait(10)
            finally:
                worker.kill()
