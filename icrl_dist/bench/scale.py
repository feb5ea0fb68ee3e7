"""How many workers one learner bears: 1, 8, 64, 256 simulated ones against the learner's own inbox and store.

A simulated worker is a session of its own over a real link, with a run's credits, which replays
recorded trajectories as fast as they are acknowledged.  Several share a process, so that two
cores bear them; they make nothing, so what is measured is the learner and the links.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import queue
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.bench import ingest
from icrl_dist.bench.stream import KEYS, LIMIT, example
from icrl_dist.config.run import ConfigError, StreamConfig
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.endpoints import parse
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Job, Spec, Trajectory
from learner.ingest import Inbox

WORKERS = (1, 8, 64, 256)
PROCESSES = 4
"""Processes that simulated workers share."""
CREDITS = StreamConfig().credits
TIMEOUT_S = StreamConfig().reply_timeout_s
KNEE = 0.9
"""The knee is the fewest workers that reach this share of the highest rate."""


class Recorded:
    """A worker's trajectories, encoded beforehand: the same one again and again under another trial number."""

    _MARK = 0x51525354
    """Numbers of this size have four bytes on the wire, and these four stand nowhere else in it."""

    def __init__(self, task: int) -> None:
        one = example()
        marked = dataclasses.replace(one, identity=one.identity._replace(task=task, trial=self._MARK))
        self._bytes = bytearray(wire.encode_trajectory(marked))
        pattern = struct.pack(">I", self._MARK)
        assert self._bytes.count(pattern) == 1
        self._place, self._numbers = self._bytes.index(pattern), itertools.count(1 << 24)

    def next(self) -> bytes:
        struct.pack_into(">I", self._bytes, self._place, next(self._numbers))
        return bytes(self._bytes)


def work(endpoint: str, first: int, count: int, seconds: float) -> None:
    """A process of ``count`` workers: connect, say so, wait for a line, send for ``seconds``; then latencies as JSON."""
    taken: list[float] = []
    with contextlib.ExitStack() as stack:
        links = [stack.enter_context(ZenohLink.connect(endpoint, 60.0)) for _ in range(count)]
        print("ready", flush=True)
        sys.stdin.readline()
        end = time.monotonic() + seconds
        resent = [0] * count

        def send(number: int) -> None:
            waiting: deque[float] = deque()
            sender = CreditSender(links[number], KEYS.data, CREDITS, TIMEOUT_S)
            acknowledged = 0
            recorded = Recorded(first + number)
            while True:
                waiting.append(time.monotonic())
                sender.send(recorded.next())
                while acknowledged < sender.acknowledged:  # answers come in the order of sending, but for resends
                    taken.append(time.monotonic() - waiting.popleft())
                    acknowledged += 1
                if time.monotonic() > end:
                    break
            sender.drain(120.0)
            resent[number] = sender.resent
            sender.close()

        threads = [threading.Thread(target=send, args=(number,)) for number in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    print(json.dumps({"taken": taken, "resent": sum(resent)}), flush=True)


def run(folder: Path = Path("runs"), seconds: float = 40.0, workers: Sequence[int] = WORKERS) -> dict[str, Any]:
    """Measure ``seconds`` in all, shared out evenly; one store a size, in a temporary folder that is removed.

    Raises ConfigError for a folder in memory, or for numbers that are not above 0.
    """
    if not seconds > 0 or not workers or min(workers) < 1:
        raise ConfigError(f"bench scale: seconds = {seconds}, workers = {list(workers)}: all must be above 0")
    kind = ingest.file_system(folder)
    if kind in ingest.IN_MEMORY:
        raise ConfigError(
            f"bench scale: {folder} lies on {kind}, where an fsync does nothing: name a folder on a disk by --folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(dir=folder, prefix="scale-") as name:
        rows = [_size(Path(name) / str(count), count, seconds / len(workers)) for count in workers]
        fsync = ingest.fsync_p50_ms(Path(name))
    best = max(row["ingest_per_s"] for row in rows)
    return {
        "rows": rows,
        "ingest_per_s": best,
        "knee_workers": next(row["workers"] for row in rows if row["ingest_per_s"] >= KNEE * best),
        "message_bytes": len(wire.encode_trajectory(example())),
        "credits": CREDITS,
        "file_system": kind,
        "fsync_p50_ms": round(fsync, 3),
        "cores": len(os.sched_getaffinity(0)),
        "load_before": round(load, 2),
    }


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    names = ("workers", "ingest_per_s", "ack_p50_ms", "ack_p99_ms", "busy", "resent", "mb", "kb_a_worker", "learner_cores")
    lines = ["".join(f"{name:>14}" for name in names)]
    lines += ["".join(f"{row[name]:>14}" for name in names) for row in result["rows"]]
    lines.append(
        f"knee: {result['knee_workers']} workers; {result['message_bytes']} bytes each, {result['credits']} credits, "
        f"{result['file_system']}, fsync p50 {result['fsync_p50_ms']} ms, load {result['load_before']}, {result['cores']} cores"
    )
    return "\n".join(lines)


def _size(folder: Path, count: int, seconds: float) -> dict[str, Any]:
    """One number of workers: from the first message sent to the last acknowledged."""
    process = psutil.Process()
    stored: list[float] = []
    failures: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
    with contextlib.closing(Dataset(folder)) as store, ZenohLink.listen("tcp/127.0.0.1:0") as link:
        inbox = _inbox(store, count, stored, failures)
        link.serve(KEYS.data, inbox.put)
        before = process.memory_info().rss
        with _workers(link.endpoints[0], count, seconds) as others:
            connected, cpu, began = process.memory_info().rss, _cpu(process), time.monotonic()
            for one in others:
                _ask(one, "go")
            most = connected
            while time.monotonic() < began + seconds:
                time.sleep(0.1)
                most = max(most, process.memory_info().rss)
            said = [json.loads(_answer(one)) for one in others]
            used, took = _cpu(process) - cpu, time.monotonic() - began
        inbox.close()
        if not failures.empty():
            raise failures.get()
    taken = sorted(itertools.chain.from_iterable(one["taken"] for one in said))
    return {
        "workers": count,
        "ingest_per_s": round(len(stored) / (stored[-1] - began), 1),
        "ack_p50_ms": round(1e3 * statistics.median(taken), 1),
        "ack_p99_ms": round(1e3 * taken[math.ceil(0.99 * (len(taken) - 1))], 1),
        "busy": inbox.drops["busy"],
        "resent": sum(one["resent"] for one in said),
        "duplicates": inbox.drops["duplicate"],
        "trajectories": len(stored),
        "trajectories_an_fsync": round(len(stored) / inbox.commits, 1),
        "mb": round(most / 1e6, 1),
        "kb_a_worker": round((connected - before) / 1e3 / count, 1),
        "learner_cores": round(used / took, 2),
    }


def _cpu(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _inbox(store: Dataset, count: int, stored: list[float], failures: queue.SimpleQueue[BaseException]) -> Inbox:
    one = example()
    size, actions = one.observations.shape[1], one.labels.shape[1]
    spec = Spec((0.0,) * size, (1.0,) * size, actions, len(one.actions))
    job = Job("adapt", *one.identity[:2], 0, (one.variation,) * count, 1, one.policy_version, seed=0, tasks=count)

    def note(_: Trajectory) -> None:
        stored.append(time.monotonic())

    return Inbox(store, spec, LIMIT, lambda _: job, lambda _: one.weights_digest, note, failures.put)


@contextlib.contextmanager
def _workers(endpoint: str, count: int, seconds: float) -> Iterator[list[subprocess.Popen[str]]]:
    """Processes whose workers are all connected."""
    assert parse(endpoint).loopback
    shares = [len(range(number, count, PROCESSES)) for number in range(min(PROCESSES, count))]
    code = "import sys; from icrl_dist.bench.scale import work; work(sys.argv[1], *map(int, sys.argv[2:4]), float(sys.argv[4]))"
    with contextlib.ExitStack() as stack:
        others = []
        for number, share in enumerate(shares):
            given = [endpoint, str(sum(shares[:number])), str(share), str(seconds)]
            words = [sys.executable, "-c", code, *given]
            one = stack.enter_context(subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            stack.callback(one.kill)
            others.append(one)
        for one in others:
            assert _answer(one) == "ready"
        yield others


def _ask(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def _answer(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"the bench's workers died: exit code {process.wait()}")
    return line.strip()
