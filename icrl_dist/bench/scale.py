"""How many workers one learner supports: 1, 8, 64 and 256 simulated workers send to the learner's ingest and store.

A simulated worker has its own session over a real link and the credits of a run, and sends a recorded
trajectory as fast as it is acknowledged.  Several share a process, so that two cores are enough.  They
simulate nothing, so the benchmark measures the learner and the links.
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
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import StreamConfig
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.endpoints import parse
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.types import Job, Spec, Trajectory
from learner.ingest import Ingest

WORKERS = (1, 8, 64, 256)
PROCESSES = 4
"""Number of processes of the simulated workers."""
CREDITS = StreamConfig().credits
TIMEOUT_S = StreamConfig().reply_timeout_s
KNEE = 0.9
"""The knee is the smallest number of workers with this share of the highest rate."""


class Recorded:
    """The trajectories of a worker, encoded in advance: one trajectory with changing trial numbers."""

    _MARK = 0x51525354
    """A trial number of four bytes on the wire that occur nowhere else in the message."""

    def __init__(self, task: int) -> None:
        trajectory = example()
        identity = trajectory.identity._replace(task=task, trial=self._MARK)
        marked = dataclasses.replace(trajectory, identity=identity)
        self._bytes = bytearray(wire.encode_trajectory(marked))
        pattern = struct.pack(">I", self._MARK)
        assert self._bytes.count(pattern) == 1
        self._place, self._numbers = self._bytes.index(pattern), itertools.count(1 << 24)

    def next(self) -> bytes:
        struct.pack_into(">I", self._bytes, self._place, next(self._numbers))
        return bytes(self._bytes)


def work(endpoint: str, first: int, count: int, seconds: float) -> None:
    """A process of ``count`` workers: connect, print ``ready``, read a line, send for ``seconds``; print latencies as JSON."""
    latencies: list[float] = []
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
                while acknowledged < sender.acknowledged:  # replies come in the order of sending, except for resends
                    latencies.append(time.monotonic() - waiting.popleft())
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
    print(json.dumps({"latencies": latencies, "resent": sum(resent)}), flush=True)


def run(folder: Path = Path("runs"), seconds: float = 40.0, workers: Sequence[int] = WORKERS) -> dict[str, Any]:
    """Measure for ``seconds`` in total, divided evenly over the numbers of workers.

    Each number has its own store, in a temporary folder under ``folder`` that is removed.  Raises
    ConfigError for a folder on a file system in memory, and for numbers that are not above 0.
    """
    if not seconds > 0 or not workers or min(workers) < 1:
        raise ConfigError(f"bench scale: seconds = {seconds}, workers = {list(workers)}: all must be above 0")
    kind = ingest.file_system(folder)
    if kind in ingest.IN_MEMORY:
        raise ConfigError(
            f"bench scale: {folder} is on {kind}, where an fsync has no effect: choose a folder on a disk with --folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(dir=folder, prefix="scale-") as name:
        rows = [_measure(Path(name) / str(count), count, seconds / len(workers)) for count in workers]
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
        f"knee: {result['knee_workers']} workers; {result['message_bytes']} bytes per message, {result['credits']} credits, "
        f"{result['file_system']}, fsync p50 {result['fsync_p50_ms']} ms, load {result['load_before']}, {result['cores']} cores"
    )
    return "\n".join(lines)


def _measure(folder: Path, count: int, seconds: float) -> dict[str, Any]:
    """The row of one number of workers, from the first message sent to the last acknowledged."""
    process = psutil.Process()
    stored: list[float] = []
    failures: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
    with contextlib.closing(Dataset(folder)) as store, ZenohLink.listen("tcp/127.0.0.1:0") as link:
        ingest = _ingest(store, count, stored, failures)
        link.serve(KEYS.data, ingest.put)
        before = process.memory_info().rss
        with _workers(link.endpoints[0], count, seconds) as others:
            connected, cpu, began = process.memory_info().rss, _cpu(process), time.monotonic()
            for other in others:
                _write(other, "go")
            peak = connected
            while time.monotonic() < began + seconds:
                time.sleep(0.1)
                peak = max(peak, process.memory_info().rss)
            reports = [json.loads(_read(other)) for other in others]
            used, took = _cpu(process) - cpu, time.monotonic() - began
        ingest.close()
        if not failures.empty():
            raise failures.get()
    latencies = sorted(itertools.chain.from_iterable(report["latencies"] for report in reports))
    return {
        "workers": count,
        "ingest_per_s": round(len(stored) / (stored[-1] - began), 1),
        "ack_p50_ms": round(1e3 * statistics.median(latencies), 1),
        "ack_p99_ms": round(1e3 * latencies[math.ceil(0.99 * (len(latencies) - 1))], 1),
        "busy": ingest.drops["busy"],
        "resent": sum(report["resent"] for report in reports),
        "duplicates": ingest.drops["duplicate"],
        "trajectories": len(stored),
        "trajectories_an_fsync": round(len(stored) / ingest.commits, 1),
        "mb": round(peak / 1e6, 1),
        "kb_a_worker": round((connected - before) / 1e3 / count, 1),
        "learner_cores": round(used / took, 2),
    }


def _cpu(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _ingest(store: Dataset, count: int, stored: list[float], failures: queue.SimpleQueue[BaseException]) -> Ingest:
    trajectory = example()
    size, actions = trajectory.observations.shape[1], trajectory.labels.shape[1]
    spec = Spec((-9.0,) * size, (9.0,) * size, actions, len(trajectory.actions))
    variations = (trajectory.variation,) * count
    job = Job("adapt", *trajectory.identity[:2], 0, variations, 1, trajectory.policy_version, seed=0, tasks=count)

    def note(_: Trajectory) -> None:
        stored.append(time.monotonic())

    return Ingest(store, spec, LIMIT, lambda _: job, lambda _: trajectory.weights_digest, note, failures.put)


@contextlib.contextmanager
def _workers(endpoint: str, count: int, seconds: float) -> Iterator[list[subprocess.Popen[str]]]:
    """Processes of simulated workers, all of them connected."""
    assert parse(endpoint).loopback
    shares = [len(range(number, count, PROCESSES)) for number in range(min(PROCESSES, count))]
    code = "import sys; from icrl_dist.bench.scale import work; work(sys.argv[1], *map(int, sys.argv[2:4]), float(sys.argv[4]))"
    with contextlib.ExitStack() as stack:
        others: list[subprocess.Popen[str]] = []
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        for number, share in enumerate(shares):
            arguments = [endpoint, str(sum(shares[:number])), str(share), str(seconds)]
            command = processes.python("-c", code, *arguments)
            other = stack.enter_context(subprocess.Popen(command, env=processes.environment(), **pipes))
            stack.callback(other.kill)
            others.append(other)
        for other in others:
            if (line := _read(other)) != "ready":
                raise RuntimeError(f"a process of simulated workers answered {line!r}")
        yield others


def _write(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def _read(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"a worker process of the benchmark ended: exit code {process.wait()}")
    return line.strip()
