"""Fuzzing of every reader of external bytes: it must return a value or refuse, within bounds of time and memory.

Input ``n`` of a seed is always the same, so every failure can be reproduced.
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
from icrl_dist.collect import kinds
from icrl_dist.collect.adapt import Rollouts
from icrl_dist.config.run import ConfigError, make_run
from icrl_dist.problems import registry
from icrl_dist.storage import segment
from icrl_dist.stream import batching, validation, wire
from icrl_dist.types import NULL, Job, Payload, Variation, Weights

LIMIT = 1 << 20
ALLOCATION = (16, 8 << 20)
"""The memory that reading may take: a multiple of the input's length, plus a number of bytes."""
LIMIT_MS = 1000.0
"""CPU time that one input may take, about a thousand times the expected time."""
HANG_S = 120.0
"""If a thousand inputs take longer, the process prints its stack and ends."""


class _FakeQuery:
    """A query whose replies are discarded."""

    key = "fuzz"

    def __init__(self, payload: bytes) -> None:
        self.payload = payload

    def reply(self, payload: bytes) -> None: ...

    def refuse(self, reason: str) -> None: ...


@dataclasses.dataclass(frozen=True)
class Target:
    """A reader of bytes, the exception with which it refuses, and valid inputs."""

    read: Callable[[bytes], object]
    refusal: type[Exception]
    valid: Sequence[bytes]


def targets() -> dict[str, Target]:
    """Every reader of external bytes by name, with valid inputs (a small and a large one where sizes differ)."""
    trajectory, names = example(), segment.Names()
    small, large = (
        wire.encode_weights(Weights(3, arrays, wire.weights_digest(arrays)))
        for arrays in ({"scale": np.array(2.0), "none": np.zeros((0, 3), np.int64)}, {"embed": trajectory.observations})
    )
    variations = (trajectory.variation, Variation(trajectory.variation.task, NULL))
    run = make_run()
    problem = registry.of(run)
    contexts, payload = problem.contexts(run).payload, Rollouts(400, "paper", "auto", 0.0, 0)
    job = Job(payload.kind, "adapt", 1, 2, variations, 4, 0, 2**40, payload)
    large_job = dataclasses.replace(job, kind=contexts.kind, payload=contexts, variations=variations * 200)

    def read_payload(kind: str, data: Any) -> Payload:
        return kinds.read_payload(kind, problem, data)

    message = wire.encode_message("hello", a=[1, {"b": None}], c=b"x", d=1.5, e="worker", f=-(2**40))
    steps, queries, window_steps = (len(array) for array in (trajectory.actions, trajectory.queries, trajectory.prev_actions))
    shapes = {"actions": (steps, 4), "adversary": (steps, 2), "labels": (queries, 4), "prev_actions": (window_steps, 4)}
    arrays: dict[str, Any] = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    vectors = dataclasses.replace(trajectory, **arrays)
    encoded = wire.encode_trajectory(trajectory)
    answers = validation.pack("answers", {"reasons": ["", "busy"]})
    name, frame = segment.encode(trajectory, names)
    frames = [frame[segment.HEADER_BYTES :], segment.encode(vectors, names)[1][segment.HEADER_BYTES :]]
    name_record = name[segment.HEADER_BYTES :][: int.from_bytes(name[4:8], "little")]
    refusal = wire.WireError
    return {
        "trajectory": Target(
            lambda data: wire.decode_trajectory(data, LIMIT), refusal, [encoded, wire.encode_trajectory(vectors)]
        ),
        "weights": Target(lambda data: wire.decode_weights(data, LIMIT), refusal, [small, large]),
        "job": Target(
            lambda data: wire.decode_job(data, read_payload, LIMIT), refusal, [wire.encode_job(job), wire.encode_job(large_job)]
        ),
        "message": Target(
            lambda data: wire.decode_message(data, LIMIT), refusal, [message, wire.encode_message("give", job=encoded)]
        ),
        "batch": Target(
            lambda data: batching.split(_FakeQuery(data), LIMIT),
            refusal,
            [batching.join([message] * 3), batching.join([large])],
        ),
        "answers": Target(lambda data: batching.reasons(data, 2), refusal, [answers]),
        "frame": Target(lambda data: segment.decode(data, names), ValueError, frames),
        "name": Target(lambda data: segment.Names().read(data), ValueError, [name_record]),
    }


def run(inputs: int = 100_000, seed: int = 0, folder: Path = Path("runs")) -> dict[str, Any]:
    """Give ``inputs`` mutated inputs to the readers in turn; failing inputs are written to files in ``folder``.

    ``ok``: every input is accepted or refused, takes at most ``LIMIT_MS`` of CPU time and at most the memory
    of ``ALLOCATION``.  ``worst_alloc_ratio`` is relative to that memory; ``memory_growth_mb`` is the growth
    of the process over all inputs.  Raises ConfigError for a number of inputs below 1.
    """
    if inputs < 1:
        raise ConfigError(f"bench fuzz: inputs = {inputs}: must be above 0")
    counts = dict.fromkeys(("accepted", "rejected", "crashes"), 0)
    worst_ms, worst_ratio = 0.0, 0.0
    failing: list[str] = []
    readers = list(targets().items())
    traced_already = tracemalloc.is_tracing()
    tracemalloc.start()
    began, memory = time.monotonic(), _peak_memory()
    try:
        for number in range(inputs):
            if number % 1000 == 0:
                faulthandler.dump_traceback_later(HANG_S, exit=True, file=2)
            name, target = readers[number % len(readers)]
            data = mutate(np.random.default_rng([seed, number]), target.valid)
            outcome, ms, ratio = attempt(target, data)
            counts[outcome] += 1
            worst_ms, worst_ratio = max(worst_ms, ms), max(worst_ratio, ratio)
            if outcome == "crashes" or ms > LIMIT_MS or ratio > 1:
                folder.mkdir(parents=True, exist_ok=True)
                file = folder / f"fuzz-{name}-{seed}-{number}.bin"
                file.write_bytes(data)
                failing.append(str(file))
    finally:
        faulthandler.cancel_dump_traceback_later()
        if not traced_already:
            tracemalloc.stop()
    return {
        "inputs": inputs,
        "seed": seed,
        **counts,
        "worst_ms": round(worst_ms, 3),
        "worst_alloc_ratio": round(worst_ratio, 3),
        "memory_growth_mb": round((_peak_memory() - memory) / 1e6, 1),
        "seconds": round(time.monotonic() - began, 1),
        "kept": failing,
        "ok": not failing,
    }


def describe(result: dict[str, Any]) -> str:
    """The result in one line, and a line per failing input."""
    line = (
        f"{result['inputs']:,} inputs: {result['accepted']:,} accepted, {result['rejected']:,} refused, {result['crashes']} "
        f"crashes; the slowest took {result['worst_ms']:.1f} ms, the largest {result['worst_alloc_ratio']:.0%} of its memory "
        "limit"
    )
    return "\n".join([line, *(f"failing input: {file}" for file in result["kept"])])


def _peak_memory() -> int:
    """The peak resident memory of this process, in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def attempt(target: Target, data: bytes) -> tuple[str, float, float]:
    """The outcome of an input, CPU milliseconds, and memory relative to its limit.  tracemalloc must be started."""
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
    factor, constant = ALLOCATION
    return outcome, ms, (tracemalloc.get_traced_memory()[1] - before) / (factor * len(data) + constant)
