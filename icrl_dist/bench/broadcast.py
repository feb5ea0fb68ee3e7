"""Seconds until the last of eight processes has loaded new weights: our broadcast against ``ray.put`` and ``ray.get``.

Both load the same weights into the same model in every process.  They alternate in one run, because
the speed of a machine varies.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import statistics
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from icrl_dist.bench.stream import local_ray
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import load_weights, weights_of
from icrl_dist.stream import wire
from icrl_dist.stream.link import Query, StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.types import Spec, Weights
from learner.broadcast import Broadcast

WIDTHS = {"1mb": 72, "12mb": 248}
"""Widths at which a transformer of four layers has this many bytes."""

LIMIT = 64 << 20
_SPEC = Spec((0.0, 0.0), (1.0, 1.0), actions=5, horizon=100)


def model(size: str) -> PretrainedTransformer:
    """A transformer of this size."""
    return PretrainedTransformer(_SPEC, ModelConfig(layers=4, heads=1, width=WIDTHS[size]))


def receive(endpoint: str) -> None:
    """A worker process: load every broadcast and report when it was loaded."""
    torch.set_num_threads(1)
    stop: queue.SimpleQueue[None] = queue.SimpleQueue()
    with ZenohLink.connect(endpoint, 30.0) as link:

        def subscribe(size: str) -> None:
            loaded, keys = model(size), StreamKeys(f"bench-{size}")

            def load(_: str, payload: bytes) -> None:
                weights = wire.decode_weights(payload, LIMIT)
                load_weights(loaded, weights.arrays)
                report(keys, f"{weights.version} {time.monotonic()}")

            link.subscribe(keys.weights, load)
            report(keys, f"-1 {time.monotonic()}")

        def report(keys: StreamKeys, text: str) -> None:
            link.send(keys.work, text.encode(), 60.0, lambda outcome: stop.put(None) if outcome == b"stop" else None)

        for size in WIDTHS:
            subscribe(size)
        stop.get()


def run(workers: int = 8, pairs: int = 10) -> dict[str, Any]:
    """Broadcast ``pairs`` times by each method and size, and return medians.

    ``ratio_*`` are medians over pairs of our time divided by Ray's.  Raises ConfigError for numbers below 1.
    """
    for name, value in (("workers", workers), ("pairs", pairs)):
        if value < 1:
            raise ConfigError(f"bench broadcast: {name} = {value}: must be above 0")
    result: dict[str, Any] = {"workers": workers, "pairs": {}}
    weights = {size: weights_of(model(size)) for size in WIDTHS}
    with _ours(workers) as ours, _ray(workers) as theirs:
        turns: dict[str, list[tuple[float, float]]] = {size: [] for size in WIDTHS}
        for turn, size in itertools.product(range(pairs + 1), WIDTHS):
            version = Weights(turn, weights[size], wire.weights_digest(weights[size]))
            pair = (ours(size, version), theirs(size, version))
            if turn:  # the first one has cold caches
                turns[size].append(pair)
    for size, times in turns.items():
        result[f"bytes_{size}"] = sum(array.nbytes for array in weights[size].values())
        result[f"ratio_{size}"] = round(statistics.median(a / b for a, b in times), 2)
        result[f"ours_ms_{size}"], result[f"ray_ms_{size}"] = (
            round(1e3 * statistics.median(column), 2) for column in zip(*times, strict=True)
        )
        result["pairs"][size] = [[round(1e3 * seconds, 2) for seconds in pair] for pair in times]
    return result


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    rows = [f"{'bytes':>12}{'ours':>10}{'Ray':>10}{'ratio':>8}   ms until all {result['workers']} have loaded the weights"]
    rows += [
        f"{result[f'bytes_{s}']:>12,}{result[f'ours_ms_{s}']:>10.1f}{result[f'ray_ms_{s}']:>10.1f}{result[f'ratio_{s}']:>8.2f}"
        for s in WIDTHS
    ]
    return "\n".join(rows)


class _OurBroadcast:
    """The learner's side: a broadcast per size, and the reports of the processes that loaded it."""

    def __init__(self, link: ZenohLink, workers: list[subprocess.Popen[bytes]]) -> None:
        self._workers = workers
        self._reports: queue.SimpleQueue[Query] = queue.SimpleQueue()
        self._broadcasts = {size: Broadcast(link, StreamKeys(f"bench-{size}"), _no_older_version) for size in WIDTHS}
        for size in WIDTHS:
            link.serve(StreamKeys(f"bench-{size}").work, self._reports.put)
        for _ in WIDTHS:
            self._last(-1)

    def __call__(self, size: str, weights: Weights) -> float:
        """Seconds until the last process has loaded these weights."""
        began = time.monotonic()
        self._broadcasts[size].publish(weights)
        return self._last(weights.version) - began

    def _last(self, version: int, answer: bytes = b"") -> float:
        """The time at which the last process loaded this version."""
        times: list[float] = []
        while len(times) < len(self._workers):
            try:
                query = self._reports.get(timeout=1.0)
            except queue.Empty:
                if dead := [w.returncode for w in self._workers if w.poll() is not None]:
                    raise RuntimeError(f"a worker process of the benchmark ended: exit code {dead[0]}") from None
                continue
            reported, moment = query.payload.split()
            if int(reported) != version:
                raise RuntimeError(f"a worker process of the benchmark loaded version {int(reported)}, not {version}")
            times.append(float(moment))
            query.reply(b"")
        return max(times)


def _no_older_version(version: int) -> Weights:
    raise KeyError(version)


class _RayBroadcast:
    """Ray's side: the same number of actors, each with the same models."""

    def __init__(self, ray: Any, workers: int) -> None:
        self._ray = ray
        self._actors = [ray.remote(num_cpus=0)(_RayLoader).remote() for _ in range(workers)]
        ray.get([actor.ready.remote() for actor in self._actors])

    def __call__(self, size: str, weights: Weights) -> float:
        """Seconds until the last actor has loaded these weights."""
        began = time.monotonic()
        reference = self._ray.put(dict(weights.arrays))
        return max(self._ray.get([actor.load.remote(size, reference) for actor in self._actors])) - began


class _RayLoader:
    def __init__(self) -> None:
        torch.set_num_threads(1)
        self._models = {size: model(size) for size in WIDTHS}

    def ready(self) -> None:
        """Returns once this actor has started."""

    def load(self, size: str, arrays: dict[str, np.ndarray]) -> float:
        """Load these weights, which Ray has fetched already, and return the time."""
        load_weights(self._models[size], arrays)
        return time.monotonic()


@contextlib.contextmanager
def _ours(workers: int) -> Iterator[_OurBroadcast]:
    command = processes.python("-c", "import sys; from icrl_dist.bench.broadcast import receive; receive(sys.argv[1])")
    with ZenohLink.listen("tcp/127.0.0.1:0") as link, contextlib.ExitStack() as stack:
        started = []
        for _ in range(workers):
            started.append(stack.enter_context(subprocess.Popen([*command, link.endpoints[0]], env=processes.environment())))
            stack.callback(started[-1].kill)
        yield _OurBroadcast(link, started)


@contextlib.contextmanager
def _ray(workers: int) -> Iterator[_RayBroadcast]:
    with local_ray() as ray:
        yield _RayBroadcast(ray, workers)
