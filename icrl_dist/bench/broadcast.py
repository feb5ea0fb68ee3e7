"""How long until the last of eight processes has loaded new weights: our broadcast beside ``ray.put`` and ``get``.

Both sides end with the same model holding the same numbers in every process; they take turns
in one run, for machines speed up and slow down.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from icrl_dist.bench.stream import local_ray
from icrl_dist.config.run import ConfigError, ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer, load_weights, weights_of
from icrl_dist.stream import wire
from icrl_dist.stream.link import Query, StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Spec, Weights
from learner.broadcast import Broadcast

WIDTHS = {"1mb": 72, "12mb": 248}
"""Widths at which a transformer of four layers has so many bytes."""

LIMIT = 64 << 20
_SPEC = Spec((0.0, 0.0), (1.0, 1.0), actions=5, horizon=100)


def model(size: str) -> PretrainedTransformer:
    """A transformer of this many bytes."""
    return PretrainedTransformer(_SPEC, ModelConfig(layers=4, heads=1, width=WIDTHS[size]))


def receive(endpoint: str) -> None:
    """A worker process: load every broadcast, and say when it was loaded."""
    torch.set_num_threads(1)
    over: queue.SimpleQueue[None] = queue.SimpleQueue()
    with ZenohLink.connect(endpoint, 30.0) as link:

        def listen(size: str) -> None:
            mine, keys = model(size), StreamKeys(f"bench-{size}")

            def take(_: str, payload: bytes) -> None:
                weights = wire.decode_weights(payload, LIMIT)
                load_weights(mine, weights.arrays)
                report(keys, f"{weights.version} {time.monotonic()}")

            link.subscribe(keys.weights, take)
            report(keys, f"-1 {time.monotonic()}")

        def report(keys: StreamKeys, text: str) -> None:
            link.send(keys.work, text.encode(), 60.0, lambda outcome: over.put(None) if outcome == b"stop" else None)

        for size in WIDTHS:
            listen(size)
        over.get()


def run(workers: int = 8, pairs: int = 10) -> dict[str, Any]:
    """Broadcast ``pairs`` times each way and size; medians.  ``ratio_*`` are medians over pairs, ours over Ray's.

    Raises ConfigError for numbers below 1.
    """
    for name, value in (("workers", workers), ("pairs", pairs)):
        if value < 1:
            raise ConfigError(f"bench broadcast: {name} = {value}: must be above 0")
    result: dict[str, Any] = {"workers": workers, "pairs": {}}
    weights = {size: weights_of(model(size)) for size in WIDTHS}
    with _ours(workers) as ours, _rays(workers) as rays:
        turns: dict[str, list[tuple[float, float]]] = {size: [] for size in WIDTHS}
        for turn, size in itertools.product(range(pairs + 1), WIDTHS):
            version = Weights(turn, weights[size], wire.weights_digest(weights[size]))
            pair = (ours(size, version), rays(size, version))
            if turn:  # the first finds cold caches
                turns[size].append(pair)
    for size, taken in turns.items():
        result[f"bytes_{size}"] = sum(array.nbytes for array in weights[size].values())
        result[f"ratio_{size}"] = round(statistics.median(a / b for a, b in taken), 2)
        result[f"ours_ms_{size}"], result[f"ray_ms_{size}"] = (
            round(1e3 * statistics.median(column), 2) for column in zip(*taken, strict=True)
        )
        result["pairs"][size] = [[round(1e3 * seconds, 2) for seconds in pair] for pair in taken]
    return result


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    rows = [f"{'bytes':>12}{'ours':>10}{'Ray':>10}{'ratio':>8}   ms until the last of {result['workers']} has loaded them"]
    rows += [
        f"{result[f'bytes_{s}']:>12,}{result[f'ours_ms_{s}']:>10.1f}{result[f'ray_ms_{s}']:>10.1f}{result[f'ratio_{s}']:>8.2f}"
        for s in WIDTHS
    ]
    return "\n".join(rows)


class _Ours:
    """The learner's side: a broadcast of each size, and the reports of the processes that loaded it."""

    def __init__(self, link: ZenohLink, workers: list[subprocess.Popen[bytes]]) -> None:
        self._workers = workers
        self._reports: queue.SimpleQueue[Query] = queue.SimpleQueue()
        self._broadcasts = {size: Broadcast(link, StreamKeys(f"bench-{size}"), _older) for size in WIDTHS}
        for size in WIDTHS:
            link.serve(StreamKeys(f"bench-{size}").work, self._reports.put)
        for _ in WIDTHS:
            self._last(-1)

    def __call__(self, size: str, weights: Weights) -> float:
        """Seconds until the last process has loaded these."""
        began = time.monotonic()
        self._broadcasts[size].publish(weights)
        return self._last(weights.version) - began

    def _last(self, version: int, answer: bytes = b"") -> float:
        """When the last of all processes reported this version."""
        times: list[float] = []
        while len(times) < len(self._workers):
            try:
                query = self._reports.get(timeout=1.0)
            except queue.Empty:
                if dead := [w.returncode for w in self._workers if w.poll() is not None]:
                    raise RuntimeError(f"a process of the bench died: exit code {dead[0]}") from None
                continue
            reported, moment = query.payload.split()
            if int(reported) != version:
                raise RuntimeError(f"a process of the bench loaded version {int(reported)}, not {version}")
            times.append(float(moment))
            query.reply(b"")
        return max(times)


def _older(version: int) -> Weights:
    raise KeyError(version)


class _Rays:
    """Ray's side: as many actors, each with the same models."""

    def __init__(self, ray: Any, workers: int) -> None:
        self._ray = ray
        self._actors = [ray.remote(num_cpus=0)(_Loader).remote() for _ in range(workers)]
        ray.get([actor.ready.remote() for actor in self._actors])

    def __call__(self, size: str, weights: Weights) -> float:
        """Seconds until the last actor has loaded these."""
        began = time.monotonic()
        reference = self._ray.put(dict(weights.arrays))
        return max(self._ray.get([actor.load.remote(size, reference) for actor in self._actors])) - began


class _Loader:
    def __init__(self) -> None:
        torch.set_num_threads(1)
        self._models = {size: model(size) for size in WIDTHS}

    def ready(self) -> None:
        """Answered once this actor is up."""

    def load(self, size: str, arrays: dict[str, np.ndarray]) -> float:
        """Load these (Ray got them already) and say when that was done."""
        load_weights(self._models[size], arrays)
        return time.monotonic()


@contextlib.contextmanager
def _ours(workers: int) -> Iterator[_Ours]:
    command = [sys.executable, "-c", "import sys; from icrl_dist.bench.broadcast import receive; receive(sys.argv[1])"]
    with ZenohLink.listen("tcp/127.0.0.1:0") as link, contextlib.ExitStack() as stack:
        processes = []
        for _ in range(workers):
            processes.append(stack.enter_context(subprocess.Popen([*command, link.endpoints[0]])))
            stack.callback(processes[-1].kill)
        yield _Ours(link, processes)


@contextlib.contextmanager
def _rays(workers: int) -> Iterator[_Rays]:
    with local_ray() as ray:
        yield _Rays(ray, workers)
