"""Trajectories a second from one worker process to one learner process: our stream beside a Ray actor.

Both sides encode each trajectory in the worker and decode and de-duplicate it in the learner,
with as many under way; they take turns in one run, for machines speed up and slow down.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import queue
import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import Keys, Query
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Adversary, Identity, Task, Trajectory, Variation

CREDITS = 8
LIMIT = 1 << 20
KEYS = Keys("bench")


def example(trial: int = 0) -> Trajectory:
    """A walker episode's worth of numbers: H = 200, S = 24, A = 6, and 30 labels; about 24 KB."""
    steps, observation, actions, queries = 200, 24, 6, 30
    rng = np.random.default_rng(0)
    return Trajectory(
        identity=Identity("adapt", 0, 0, 0, trial),
        variation=Variation(Task.of("dmc", problem="walker-run", mass=5.0), Adversary.of("force", strength=1.0)),
        weights=0,
        digest="0" * 64,
        worker="bench",
        observations=rng.normal(size=(steps + 1, observation)).astype(np.float32),
        actions=np.zeros(steps, np.int16),
        rewards=rng.random(steps, np.float32),
        adversary=np.full(steps, -1, np.int16),
        queries=rng.normal(size=(queries, observation)).astype(np.float32),
        labels=rng.random((queries, actions), np.float32),
        origin="heuristic",
    )


class Source:
    """A worker's endless trajectories, encoded, each with an identity of its own."""

    def __init__(self) -> None:
        self._example = example()
        self._made = 0

    def make(self) -> bytes:
        self._made += 1
        identity = self._example.identity._replace(trial=self._made)
        return wire.encode_trajectory(dataclasses.replace(self._example, identity=identity))


class Sink:
    """A learner's memory: what it has seen, once each."""

    def __init__(self) -> None:
        self.seen: dict[Identity, Trajectory] = {}

    def take(self, data: bytes) -> None:
        trajectory = wire.decode_trajectory(data, LIMIT)
        self.seen.setdefault(trajectory.identity, trajectory)


def work(endpoint: str) -> None:
    """The worker process: ask for seconds of work, send for so long, until refused."""
    source = Source()
    with ZenohLink.connect(endpoint, 10.0) as link:
        sender = CreditSender(link, KEYS.data, CREDITS, 10.0)
        while seconds := float(link.request(KEYS.work, b"", 600.0)):
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                sender.send(source.make())
            sender.drain(10.0)
        sender.close()


def run(seconds: float = 8.0, pairs: int = 3) -> dict[str, Any]:
    """Measure both for ``seconds`` in all, taking turns; rates are medians over the turns."""
    turn = seconds / (2 * pairs)
    ours: list[float] = []
    rays: list[float] = []
    with _stream() as stream, _ray() as ray_actor:
        stream(turn / 4)
        ray_actor(turn / 4)
        for _ in range(pairs):
            ours.append(stream(turn))
            rays.append(ray_actor(turn))
    return {
        "stream_per_s": round(statistics.median(ours), 1),
        "ray_per_s": round(statistics.median(rays), 1),
        "ratio": round(statistics.median(a / b for a, b in zip(ours, rays, strict=True)), 2),
        "message_bytes": len(wire.encode_trajectory(example())),
        "credits": CREDITS,
        "pairs": [[round(a, 1), round(b, 1)] for a, b in zip(ours, rays, strict=True)],
    }


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    rows = [f"{'turn':<6}{'stream':>10}{'Ray actor':>12}{'ratio':>8}   trajectories/s of {result['message_bytes']} bytes"]
    rows += [f"{i:<6}{a:>10.0f}{b:>12.0f}{a / b:>8.2f}" for i, (a, b) in enumerate(result["pairs"], 1)]
    rows += [f"{'median':<6}{result['stream_per_s']:>10.0f}{result['ray_per_s']:>12.0f}{result['ratio']:>8.2f}"]
    return "\n".join(rows)


class _Stream:
    def __init__(self, link: ZenohLink, worker: subprocess.Popen[bytes]) -> None:
        self._sink, self._worker = Sink(), worker
        self._data: queue.SimpleQueue[Query] = queue.SimpleQueue()
        self._idle: queue.SimpleQueue[Query] = queue.SimpleQueue()
        link.serve(KEYS.data, self._data.put)
        link.serve(KEYS.work, self._idle.put)
        self._waiting = self._idle.get(timeout=60)

    def __call__(self, seconds: float) -> float:
        before, start = len(self._sink.seen), time.monotonic()
        self._waiting.reply(b"%f" % seconds)
        while True:
            try:
                query = self._data.get(timeout=0.02)
            except queue.Empty:
                if not self._idle.empty():
                    break
                if self._worker.poll() is not None:
                    raise RuntimeError(f"the bench's worker process died: exit code {self._worker.returncode}") from None
                continue
            self._sink.take(query.payload)
            query.reply(b"stored")
            last = time.monotonic()
        self._waiting = self._idle.get()
        return (len(self._sink.seen) - before) / (last - start)

    def stop(self) -> None:
        self._waiting.reply(b"0")


@contextlib.contextmanager
def _stream() -> Iterator[_Stream]:
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        command = [sys.executable, "-c", "import sys; from icrl_dist.bench.stream import work; work(sys.argv[1])"]
        with subprocess.Popen([*command, link.endpoints[0]]) as worker:
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
        ray.get(self._source.make.remote())

    def __call__(self, seconds: float) -> float:
        before, start = len(self._sink.seen), time.monotonic()
        end = start + seconds
        under_way = deque(self._source.make.remote() for _ in range(CREDITS))
        while under_way:
            self._sink.take(self._ray.get(under_way.popleft()))
            if time.monotonic() < end:
                under_way.append(self._source.make.remote())
        return (len(self._sink.seen) - before) / (time.monotonic() - start)


@contextlib.contextmanager
def _ray() -> Iterator[_RayActor]:
    import ray

    if ray.is_initialized():
        raise RuntimeError("a Ray session is open in this process: run this benchmark in one of its own")
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
        configure_logging=False,
    )
    try:
        yield _RayActor(ray)
    finally:
        ray.shutdown()
