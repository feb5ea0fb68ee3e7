"""Hostile bytes into every reader of bytes: a value or a refusal, soon, and within a stated amount of memory.

Input ``n`` of a seed is always the same one, so whatever is found can be made again.
"""

from __future__ import annotations

import dataclasses
import faulthandler
import resource
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl_dist.bench.mutations import mutate
from icrl_dist.bench.stream import example
from icrl_dist.config.run import ConfigError
from icrl_dist.storage import segment
from icrl_dist.stream import batching, validation, wire
from icrl_dist.types import NULL, Job, Variation, Weights

LIMIT = 1 << 20
ALLOCATION = (16, 8 << 20)
"""Reading may take so many times an input's length, and so many bytes besides."""
LIMIT_MS = 1000.0
"""CPU time that one input may take; a thousandfold of what one should."""
HANG_S = 120.0
"""A thousand inputs that take so long end the process with a trace of where it is."""


class _Query:
    """A request that nobody waits for."""

    key = "fuzz"

    def __init__(self, payload: bytes) -> None:
        self.payload = payload

    def reply(self, payload: bytes) -> None: ...

    def refuse(self, reason: str) -> None: ...


@dataclasses.dataclass(frozen=True)
class Target:
    """A reader, what it may raise, and inputs that it takes."""

    read: Callable[[bytes], object]
    refusal: type[Exception]
    valid: Sequence[bytes]


def targets() -> dict[str, Target]:
    """Every reader of bytes that come from elsewhere, each with a small and a large input where there is such a thing."""
    one, names = example(), segment.Names()
    small, large = (
        wire.encode_weights(Weights(3, arrays, wire.weights_digest(arrays)))
        for arrays in ({"scale": np.array(2.0), "none": np.zeros((0, 3), np.int64)}, {"embed": one.observations})
    )
    variations = (one.variation, Variation(one.variation.task, NULL))
    job = Job("adapt", "adapt", 1, 2, variations, 4, 0, 2**40, (("beta", 1.0),))
    many = dataclasses.replace(job, variations=variations * 200)
    message = wire.encode_message("hello", a=[1, {"b": None}], c=b"x", d=1.5, e="worker", f=-(2**40))
    steps, queries, taken = (len(array) for array in (one.actions, one.queries, one.taken))
    shapes = {"actions": (steps, 4), "adversary": (steps, 2), "labels": (queries, 4), "taken": (taken, 4)}
    arrays: dict[str, Any] = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    vectors = dataclasses.replace(one, **arrays)
    trajectory = wire.encode_trajectory(one)
    answers = validation.pack("answers", {"reasons": ["", "busy"]})
    name, frame = segment.encode(one, names)
    frames = [frame[segment.HEADER_BYTES :], segment.encode(vectors, names)[1][segment.HEADER_BYTES :]]
    first = name[segment.HEADER_BYTES :][: int.from_bytes(name[4:8], "little")]
    refusal = wire.WireError
    return {
        "trajectory": Target(
            lambda data: wire.decode_trajectory(data, LIMIT), refusal, [trajectory, wire.encode_trajectory(vectors)]
        ),
        "weights": Target(lambda data: wire.decode_weights(data, LIMIT), refusal, [small, large]),
        "job": Target(lambda data: wire.decode_job(data, LIMIT), refusal, [wire.encode_job(job), wire.encode_job(many)]),
        "message": Target(
            lambda data: wire.decode_message(data, LIMIT), refusal, [message, wire.encode_message("give", job=trajectory)]
        ),
        "batch": Target(
            lambda data: batching.split(_Query(data), LIMIT), refusal, [batching.join([message] * 3), batching.join([large])]
        ),
        "answers": Target(lambda data: batching.reasons(data, 2), refusal, [answers]),
        "frame": Target(lambda data: segment.decode(data, names), ValueError, frames),
        "name": Target(lambda data: segment.Names().read(data), ValueError, [first]),
    }


def run(inputs: int = 100_000, seed: int = 0, folder: Path = Path("runs")) -> dict[str, Any]:
    """Feed ``inputs`` to the readers in turn.  An input that breaks one is kept as a file under ``folder``.

    ``ok``: nothing but values and refusals, none slower than ``LIMIT_MS`` of CPU time, none
    that took more memory than ``ALLOCATION`` allows.  ``worst_alloc_ratio`` is of what is allowed;
    ``memory_growth_mb`` is of the process, from before the first input to the end.
    Raises ConfigError for a number of inputs below 1.
    """
    if inputs < 1:
        raise ConfigError(f"bench fuzz: inputs = {inputs}: must be above 0")
    counts = dict.fromkeys(("accepted", "rejected", "crashes"), 0)
    worst_ms, worst_ratio = 0.0, 0.0
    kept: list[str] = []
    aims = list(targets().items())
    outer = tracemalloc.is_tracing()
    tracemalloc.start()
    began, memory = time.monotonic(), _most_memory()
    try:
        for number in range(inputs):
            if number % 1000 == 0:
                faulthandler.dump_traceback_later(HANG_S, exit=True, file=2)
            name, target = aims[number % len(aims)]
            data = mutate(np.random.default_rng([seed, number]), target.valid)
            outcome, ms, ratio = attempt(target, data)
            counts[outcome] += 1
            worst_ms, worst_ratio = max(worst_ms, ms), max(worst_ratio, ratio)
            if outcome == "crashes" or ms > LIMIT_MS or ratio > 1:
                folder.mkdir(parents=True, exist_ok=True)
                file = folder / f"fuzz-{name}-{seed}-{number}.bin"
                file.write_bytes(data)
                kept.append(str(file))
    finally:
        faulthandler.cancel_dump_traceback_later()
        if not outer:
            tracemalloc.stop()
    return {
        "inputs": inputs,
        "seed": seed,
        **counts,
        "worst_ms": round(worst_ms, 3),
        "worst_alloc_ratio": round(worst_ratio, 3),
        "memory_growth_mb": round((_most_memory() - memory) / 1e6, 1),
        "seconds": round(time.monotonic() - began, 1),
        "kept": kept,
        "ok": not kept,
    }


def describe(result: dict[str, Any]) -> str:
    """The result in a line, and one for each input that was kept."""
    line = (
        f"{result['inputs']:,} inputs: {result['accepted']:,} accepted, {result['rejected']:,} refused, {result['crashes']} "
        f"crashes; the slowest took {result['worst_ms']:.1f} ms, the largest {result['worst_alloc_ratio']:.0%} of the memory "
        "it may take"
    )
    return "\n".join([line, *(f"kept: {file}" for file in result["kept"])])


def _most_memory() -> int:
    """The most that this process ever had resident, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def attempt(target: Target, data: bytes) -> tuple[str, float, float]:
    """What became of an input, CPU milliseconds, and its share of the memory that it may take.  Needs tracemalloc on."""
    tracemalloc.reset_peak()
    before, began = tracemalloc.get_traced_memory()[0], time.thread_time()
    try:
        target.read(data)
        outcome = "accepted"
    except target.refusal:
        outcome = "rejected"
    except Exception:
        outcome = "crashes"
    ms = 1e3 * (time.thread_time() - began)
    times, besides = ALLOCATION
    return outcome, ms, (tracemalloc.get_traced_memory()[1] - before) / (times * len(data) + besides)
