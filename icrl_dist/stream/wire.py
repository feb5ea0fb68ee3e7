"""The wire format: trajectories, weights, jobs and small messages as msgpack maps with a version number.

An array is ``[dtype, shape, bytes]``.  Every field is checked and nothing is unpickled.  An
invalid message, whether it is encoded or decoded, raises :class:`WireError` with one of the
reasons in ``REASONS``, and nothing else.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import msgpack
import numpy as np
from annotated_types import Ge, Interval

from icrl_dist.stream import schema
from icrl_dist.stream.excerpts import show
from icrl_dist.stream.validation import (
    DEPTH,
    REASONS,
    VERSION,
    WEIGHT_DTYPES,
    Count,
    Stage,
    WireError,
    as_list,
    as_map,
    check_plain,
    exactly,
    from_array,
    pack,
    read,
    text,
    to_array,
    unpack,
)
from icrl_dist.types import (
    ARRAYS,
    VECTORS,
    Adversary,
    Identity,
    Job,
    Params,
    Payload,
    Task,
    Trajectory,
    Value,
    Variation,
    Weights,
)

__all__ = ["REASONS", "VERSION", "WireError"]

SMALL = 1 << 20
"""Default limit of jobs and messages, bytes."""

_LARGEST = (1 << 31) - 1
"""Largest number of an identity, and largest weights version, that the dataset can store."""

_T = TypeVar("_T")
_Number = Annotated[int, Interval(ge=0, le=_LARGEST)]


@dataclass(frozen=True, slots=True)
class _TrajectoryFields:
    identity: tuple[Stage, _Number, _Number, _Number, _Number]
    variation: Any
    policy_version: Annotated[int, Interval(ge=-1, le=_LARGEST)]
    weights_digest: str
    worker: str
    origin: str
    arrays: Any


@dataclass(frozen=True, slots=True)
class _WeightsFields:
    version: _Number
    digest: str
    arrays: Any


@dataclass(frozen=True, slots=True)
class _JobFields:
    job: str
    stage: Stage
    round: Count
    task: Count
    variations: Any
    trials: Count
    policy_version: Annotated[int, Ge(-1)]
    seed: Count
    payload: Any
    tasks: Annotated[int, Ge(1)]
    first: Count


def encode_trajectory(trajectory: Trajectory) -> bytes:
    """The trajectory as bytes.  Raises WireError for a trajectory that the decoder would refuse."""
    arrays = trajectory.arrays()
    kinds = ARRAYS if arrays["actions"].ndim == 1 else VECTORS
    for name, array in arrays.items():
        _check_kind(name, array.dtype.str, array.ndim, *kinds[name])
    _check_lengths(arrays)
    return pack(
        "trajectory",
        {
            "identity": list(trajectory.identity),
            "variation": from_variation(trajectory.variation),
            "policy_version": trajectory.policy_version,
            "weights_digest": trajectory.weights_digest,
            "worker": trajectory.worker,
            "origin": trajectory.origin,
            "arrays": {name: from_array(array) for name, array in arrays.items()},
        },
    )


def decode_trajectory(data: bytes, limit: int) -> Trajectory:
    """The trajectory in ``data``, of at most ``limit`` bytes; its arrays are read-only views.

    The arrays' values are not checked here: ingest checks that they are finite and within the
    environment's bounds.
    """
    fields = _decode(_TrajectoryFields, data, limit, "trajectory")
    raw = exactly(fields.arrays, "arrays", ARRAYS.keys())
    kinds = VECTORS if as_list(raw["actions"], "actions", 3)[0] == VECTORS["actions"][0] else ARRAYS
    arrays = {name: to_array(name, raw[name], (dtype,), ndim) for name, (dtype, ndim) in kinds.items()}
    _check_lengths(arrays)
    return Trajectory(
        identity=Identity(*fields.identity),
        variation=to_variation(fields.variation),
        policy_version=fields.policy_version,
        weights_digest=fields.weights_digest,
        worker=fields.worker,
        origin=fields.origin,
        **arrays,
    )


def trajectory_digest(trajectory: Trajectory) -> str:
    """SHA-256 of a trajectory without its worker's name, hexadecimal; so every worker gives the same one."""
    head = [
        list(trajectory.identity),
        from_variation(trajectory.variation),
        trajectory.policy_version,
        trajectory.weights_digest,
        trajectory.origin,
    ]
    return _hash(head, trajectory.arrays().items())


def weights_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of a model's parameters: sorted names, dtypes, shapes and bytes, hexadecimal."""
    return _hash([], sorted(arrays.items()))


def encode_weights(weights: Weights) -> bytes:
    """The weights as bytes, without a check of their digest: the reader checks it.  Raises WireError for a wrong dtype."""
    for name, array in weights.arrays.items():
        if array.dtype.str not in WEIGHT_DTYPES:
            raise WireError("dtype", f"{name} is {array.dtype.str}, expected one of {sorted(WEIGHT_DTYPES)}")
    return pack(
        "weights",
        {
            "version": weights.version,
            "digest": weights.digest,
            "arrays": {name: from_array(array) for name, array in weights.arrays.items()},
        },
    )


def decode_weights(data: bytes, limit: int) -> Weights:
    """The weights in ``data``, of at most ``limit`` bytes.

    Raises WireError if their digest is not that of their arrays, or if a value is infinite or not a number.
    """
    fields = _decode(_WeightsFields, data, limit, "weights")
    arrays = {text(n, "arrays"): to_array(n, a, WEIGHT_DTYPES, None) for n, a in as_map(fields.arrays, "arrays").items()}
    _check_digest(fields.digest, arrays)
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise WireError("schema", f"{show(name)} holds a value that is infinite or not a number")
    return Weights(fields.version, arrays, fields.digest)


def encode_job(job: Job) -> bytes:
    """The job as bytes."""
    return pack(
        "job",
        {
            "job": job.kind,
            "stage": job.stage,
            "round": job.round,
            "task": job.task,
            "variations": [from_variation(v) for v in job.variations],
            "trials": job.trials,
            "policy_version": job.policy_version,
            "seed": job.seed,
            "payload": schema.as_data(job.payload),
            "tasks": job.tasks,
            "first": job.first,
        },
    )


ReadPayload = Callable[[str, Any], Payload]
"""``read(kind, data)``: the payload of a job of this kind from plain data; raises ValueError for an impossible one."""


def decode_job(data: bytes, read_payload: ReadPayload, limit: int = SMALL) -> Job:
    """The job in ``data``, equal to the encoded one; ``read_payload`` decodes what its kind needs."""
    fields = _decode(_JobFields, data, limit, "job")
    check_plain(fields.payload, "payload", DEPTH)
    try:
        payload = read_payload(fields.job, fields.payload)
    except ValueError as error:
        raise WireError("schema", str(error)) from None
    return Job(
        kind=fields.job,
        stage=fields.stage,
        round=fields.round,
        task=fields.task,
        variations=tuple(to_variation(v) for v in as_list(fields.variations, "variations")),
        trials=fields.trials,
        policy_version=fields.policy_version,
        seed=fields.seed,
        payload=payload,
        tasks=fields.tasks,
        first=fields.first,
    )


def encode_message(kind: str, **fields: object) -> bytes:
    """A small message: None, bool, int, float, str, bytes, and lists and maps of them, at most 8 deep."""
    for name in ("v", "kind"):
        if name in fields:
            raise WireError("schema", f"{name!r} is a key of every message: name the field otherwise")
    check_plain({"kind": kind, **fields}, "message", DEPTH)
    return pack(kind, fields)


def decode_message(data: bytes, limit: int = SMALL) -> tuple[str, dict[str, Any]]:
    """A small message's kind and fields."""
    message = unpack(data, limit)
    check_plain(message, "message", DEPTH)
    del message["v"]
    return text(message.pop("kind", None), "kind"), message


def _decode(cls: type[_T], data: bytes, limit: int, kind: str) -> _T:
    message = unpack(data, limit)
    if message.get("kind") != kind:
        raise WireError("schema", f"kind {show(message.get('kind'))}, expected {kind!r}")
    del message["v"], message["kind"]
    return read(cls, message)


def _from_params(params: Params) -> list[object]:
    return [[name, list(value) if isinstance(value, tuple) else value] for name, value in params]


def _to_params(value: object, what: str) -> Params:
    pairs = (as_list(pair, what, 2) for pair in as_list(value, what))
    return tuple((text(name, what), _to_value(v, what)) for name, v in pairs)


def _to_value(value: object, what: str) -> Value:
    if isinstance(value, (bool, int, float, str)):
        return value
    numbers = as_list(value, what)
    for number in numbers:
        if not isinstance(number, (int, float)):
            raise WireError("schema", f"{what} holds {show(number)}, expected numbers")
    return tuple(numbers)


def from_variation(variation: Variation) -> list[object]:
    """A variation as plain lists."""
    return [[named.kind, _from_params(named.params)] for named in (variation.task, variation.adversary)]


def to_variation(value: object) -> Variation:
    """The inverse of ``from_variation``.  Raises WireError for other values."""
    (task, of_task), (adversary, of_adversary) = (as_list(named, "variation", 2) for named in as_list(value, "variation", 2))
    return Variation(
        Task(text(task, "task"), _to_params(of_task, "task")),
        Adversary(text(adversary, "adversary"), _to_params(of_adversary, "adversary")),
    )


def _check_kind(name: str, dtype: str, ndim: int, expected: str, rank: int) -> None:
    if dtype != expected:
        raise WireError("dtype", f"{name} is {dtype}, expected {expected}")
    if ndim != rank:
        raise WireError("shape", f"{name} has {ndim} dimensions, expected {rank}")


def _check_lengths(arrays: Mapping[str, np.ndarray]) -> None:
    steps, queries, window_steps = (len(arrays[name]) for name in ("actions", "queries", "prev_actions"))
    wanted = {"observations": steps + 1, "rewards": steps, "adversary": steps, "labels": queries, "prev_rewards": window_steps}
    for name, rows in wanted.items():
        if len(arrays[name]) != rows:
            raise WireError("shape", f"{name} has {len(arrays[name])} rows, expected {rows}")
    if window_steps > queries:
        raise WireError("shape", f"prev_actions has {window_steps} rows, expected at most {queries}")
    if arrays["queries"].shape[1] != arrays["observations"].shape[1]:
        shapes = arrays["queries"].shape, arrays["observations"].shape
        raise WireError("shape", f"queries and observations have shapes {shapes}, expected equal numbers of components")
    if arrays["actions"].ndim == 1:
        return
    widths = {name: arrays[name].shape[1] for name in ("actions", "prev_actions", "labels")}
    if len(set(widths.values())) != 1:
        raise WireError("shape", f"action vectors have {widths} components, expected equal numbers")


def _check_digest(digest: str, arrays: Mapping[str, np.ndarray]) -> None:
    found = weights_digest(arrays)
    if found != digest:
        raise WireError("digest", f"the arrays have the digest {found}, expected {show(digest)}")


def _hash(head: list[object], arrays: Iterable[tuple[str, np.ndarray]]) -> str:
    found = hashlib.sha256(msgpack.packb(head))
    for name, array in arrays:
        found.update(_title(name, array.dtype.str, array.shape))
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


@functools.lru_cache(maxsize=1024)
def _title(name: str, dtype: str, shape: tuple[int, ...]) -> bytes:
    return bytes(msgpack.packb([name, dtype, shape]))
