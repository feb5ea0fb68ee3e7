"""Trajectories per second from one worker process to one learner process: our stream against a Ray actor.

Both move the same bytes, encoded in advance and not decoded, with the same number in flight.  They
alternate in one run, because the speed of a machine varies.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import statistics
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from actors.session import Session
from icrl_dist.stream import batching, wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import Query, StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.types import Adversary, Identity, Task, Trajectory, Variation

_log = logging.getLogger(__name__)

CREDITS = 8
LIMIT = 1 << 20
KEYS = StreamKeys("bench")


def example(trial: int = 0) -> Trajectory:
    """A trajectory of the size of a walker episode: H = 200, S = 24, A = 6, and 30 labels; about 24 KB."""
    steps, observation, actions, queries = 200, 24, 6, 30
    rng = np.random.default_rng(0)
    labels = rng.random((queries, actions), np.float32)
    return Trajectory(
        identity=Identity("adapt", 0, 0, 0, trial),
        variation=Variation(Task.of("dmc", problem="walker-run", mass=5.0), Adversary.of("force", strength=1.0)),
        policy_version=0,
        weights_digest="0" * 64,
        worker="bench",
        observations=rng.normal(size=(steps + 1, observation)).astype(np.float32),
        actions=np.zeros(steps, np.int16),
        rewards=rng.random(steps, np.float32),
        adversary=np.full(steps, -1, np.int16),
        queries=rng.normal(size=(queries, observation)).astype(np.float32),
        labels=labels / labels.sum(axis=1, keepdims=True),
        prev_actions=np.zeros(0, np.int16),
        prev_rewards=np.zeros(0, np.float32),
        origin="heuristic",
    )


class Source:
    """A worker's trajectories, encoded in advance, so that only the stream is measured."""

    def __init__(self) -> None:
        self._ready = [wire.encode_trajectory(example(trial)) for trial in range(64)]
        self._made = 0

    def next(self) -> bytes:
        self._made += 1
        return self._ready[self._made % len(self._ready)]


class Sink:
    """A learner that only counts messages."""

    def __init__(self) -> None:
        self.count = 0

    def take(self, data: bytes) -> None:
        self.count += len(data) > 0


def work(endpoint: str) -> None:
    """The worker process: request a number of seconds and send for that long, until the number is 0."""
    source = Source()
    with ZenohLink.connect(endpoint, 10.0) as link:
        sender = CreditSender(link, KEYS.data, CREDITS, 10.0)
        while seconds := float(link.request(KEYS.work, b"", 600.0)):
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                sender.send(source.next())
            sender.drain(10.0)
        sender.close()


def run(seconds: float = 15.0, pairs: int = 5) -> dict[str, Any]:
    """Measure for ``seconds`` in total, alternating; rates and ratios are medians over turns.

    Ray is measured twice: with results fetched in the order of the calls, its fastest way with one actor
    (``ray_per_s``), and as they arrive by ``ray.wait`` (``ray_wait_per_s``), which a learner with many
    actors needs and our stream always does.
    """
    turn = seconds / (3 * pairs)
    turns: list[tuple[float, float, float]] = []
    with _stream() as stream, _ray() as actor:
        for warm_up in (stream, actor.in_order, actor.as_ready):
            warm_up(turn / 4)
        for _ in range(pairs):
            turns.append((stream(turn), actor.in_order(turn), actor.as_ready(turn)))
    ours, in_order, as_ready = (round(statistics.median(column), 1) for column in zip(*turns, strict=True))
    return {
        "stream_per_s": ours,
        "ray_per_s": in_order,
        "ray_wait_per_s": as_ready,
        "ratio": round(statistics.median(a / b for a, b, _ in turns), 2),
        "ratio_wait": round(statistics.median(a / c for a, _, c in turns), 2),
        "message_bytes": len(wire.encode_trajectory(example())),
        "credits": CREDITS,
        "pairs": [[round(rate, 1) for rate in rates] for rates in turns],
    }


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    rows = [f"{'turn':<8}{'stream':>8}{'Ray':>8}{'ray.wait':>10}   trajectories/s of {result['message_bytes']} bytes"]
    rows += [f"{i:<8}{a:>8.0f}{b:>8.0f}{c:>10.0f}" for i, (a, b, c) in enumerate(result["pairs"], 1)]
    rows += [f"{'median':<8}{result['stream_per_s']:>8.0f}{result['ray_per_s']:>8.0f}{result['ray_wait_per_s']:>10.0f}"]
    rows += [f"stream / Ray: {result['ratio']:.2f}, stream / ray.wait: {result['ratio_wait']:.2f}"]
    return "\n".join(rows)


class _Stream:
    def __init__(self, link: ZenohLink, worker: subprocess.Popen[bytes]) -> None:
        self._sink, self._worker = Sink(), worker
        self._data: queue.SimpleQueue[Query] = queue.SimpleQueue()
        self._idle: queue.SimpleQueue[Query] = queue.SimpleQueue()
        link.serve(KEYS.data, self._split)
        link.serve(KEYS.work, self._idle.put)
        self._waiting = self._idle.get(timeout=60)

    def __call__(self, seconds: float) -> float:
        before, start = self._sink.count, time.monotonic()
        self._waiting.reply(b"%f" % seconds)
        while True:
            try:
                query = self._data.get(timeout=0.02)
            except queue.Empty:
                if not self._idle.empty():
                    break
                if self._worker.poll() is not None:
                    raise RuntimeError(f"the worker process ended: exit code {self._worker.returncode}") from None
                continue
            self._sink.take(query.payload)
            query.reply(b"stored")
            last = time.monotonic()
        self._waiting = self._idle.get()
        return (self._sink.count - before) / (last - start)

    def _split(self, query: Query) -> None:
        for part in batching.split(query, LIMIT):
            self._data.put(part)

    def stop(self) -> None:
        self._waiting.reply(b"0")


@contextlib.contextmanager
def _stream() -> Iterator[_Stream]:
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        command = processes.python("-c", "import sys; from icrl_dist.bench.stream import work; work(sys.argv[1])")
        with subprocess.Popen([*command, link.endpoints[0]], env=processes.environment()) as worker:
            try:
                stream = _Stream(link, worker)
                yield stream
                stream.stop()
                worker.wait(10)
            finally:
                worker.kill()


class _RayActor:
    def __init__(self, ray: Any) -> None:
        self._ray, self._sink = ray, Sink()
        self._source = ray.remote(num_cpus=1)(Source).remote()
        ray.get(self._source.next.remote())

    def in_order(self, seconds: float) -> float:
        """Take the results in the order of the calls."""
        before, start = self._sink.count, time.monotonic()
        in_flight = deque(self._source.next.remote() for _ in range(CREDITS))
        while in_flight:
            self._sink.take(self._ray.get(in_flight.popleft()))
            if time.monotonic() < start + seconds:
                in_flight.append(self._source.next.remote())
        return (self._sink.count - before) / (time.monotonic() - start)

    def as_ready(self, seconds: float) -> float:
        """Take results as they become ready, as a learner with many actors must."""
        before, start = self._sink.count, time.monotonic()
        in_flight = [self._source.next.remote() for _ in range(CREDITS)]
        while in_flight:
            ready, in_flight = self._ray.wait(in_flight, num_returns=1)
            for data in self._ray.get(ready):
                self._sink.take(data)
                if time.monotonic() < start + seconds:
                    in_flight.append(self._source.next.remote())
        return (self._sink.count - before) / (time.monotonic() - start)


@contextlib.contextmanager
def _ray() -> Iterator[_RayActor]:
    with local_ray() as ray:
        yield _RayActor(ray)


@contextlib.contextmanager
def local_ray() -> Iterator[Any]:
    """A local Ray for the duration of a benchmark.  Raises RuntimeError if Ray is already initialized in this process."""
    import ray

    if ray.is_initialized():
        raise RuntimeError("Ray is already initialized in this process: run this benchmark in a new process")
    session = Session(ray, _log.warning, num_cpus=2, configure_logging=False)
    try:
        yield ray
    finally:
        session.close()
