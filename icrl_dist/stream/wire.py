"""The bytes that travel: msgpack maps with a version, checked field by field, read without pickle.

An array is ``[dtype, shape, bytes]``.  Whatever is wrong with a message, in either direction,
raises :class:`WireError` with one of the reasons in ``REASONS``; nothing else is raised.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping, Set
from typing import Any

import msgpack
import numpy as np

from icrl_dist.stream import schema
from icrl_dist.stream.validation import (
    DEPTH,
    REASONS,
    VERSION,
    WEIGHT_DTYPES,
    WireError,
    as_list,
    as_map,
    check_plain,
    exactly,
    from_array,
    integer,
    pack,
    show,
    text,
    to_array,
    unpack,
)
from icrl_dist.types import (
    ARRAYS,
    STAGES,
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
"""What store and ledger can hold of an identity's numbers and of weights versions."""


def encode_trajectory(trajectory: Trajectory) -> bytes:
    """The trajectory as bytes.  The producer's mistakes are refused here, as the reader would refuse them."""
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

    What the arrays hold (finiteness, the environment's bounds) is not the wire's to judge.
    """
    fields = _fields(data, limit, "trajectory", _TRAJECTORY)
    raw = exactly(fields["arrays"], "arrays", ARRAYS.keys())
    kinds = VECTORS if as_list(raw["actions"], "actions", 3)[0] == VECTORS["actions"][0] else ARRAYS
    arrays = {name: to_array(name, raw[name], (dtype,), ndim) for name, (dtype, ndim) in kinds.items()}
    _check_lengths(arrays)
    return Trajectory(
        identity=_to_identity(fields["identity"]),
        variation=to_variation(fields["variation"]),
        policy_version=integer(fields["policy_version"], "policy_version", -1, _LARGEST),
        weights_digest=text(fields["weights_digest"], "weights_digest"),
        worker=text(fields["worker"], "worker"),
        origin=text(fields["origin"], "origin"),
        **arrays,
    )


def trajectory_digest(trajectory: Trajectory) -> str:
    """SHA-256 of all that a trajectory says, hexadecimal; the same whichever worker made it."""
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
    """The weights as bytes; their digest must be that of their arrays."""
    for name, array in weights.arrays.items():
        if array.dtype.str not in WEIGHT_DTYPES:
            raise WireError("dtype", f"{name} is {array.dtype.str}, expected one of {sorted(WEIGHT_DTYPES)}")
    _check_digest(weights.digest, weights.arrays)
    return pack(
        "weights",
        {
            "version": weights.version,
            "digest": weights.digest,
            "arrays": {name: from_array(array) for name, array in weights.arrays.items()},
        },
    )


def decode_weights(data: bytes, limit: int) -> Weights:
    """The weights in ``data``, of at most ``limit`` bytes, if they hash to the digest they came with."""
    fields = _fields(data, limit, "weights", _WEIGHTS)
    arrays = {text(n, "arrays"): to_array(n, a, WEIGHT_DTYPES, None) for n, a in as_map(fields["arrays"], "arrays").items()}
    digest = text(fields["digest"], "digest")
    _check_digest(digest, arrays)
    return Weights(integer(fields["version"], "version", 0, _LARGEST), arrays, digest)


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
    """The job in ``data``, equal to the one encoded; ``read_payload`` decodes what its kind needs."""
    fields = _fields(data, limit, "job", _JOB)
    kind = text(fields["job"], "job")
    check_plain(fields["payload"], "payload", DEPTH)
    try:
        payload = read_payload(kind, fields["payload"])
    except ValueError as error:
        raise WireError("schema", str(error)) from None
    return Job(
        kind=kind,
        stage=_stage(fields["stage"]),
        round=integer(fields["round"], "round", 0),
        task=integer(fields["task"], "task", 0),
        variations=tuple(to_variation(v) for v in as_list(fields["variations"], "variations")),
        trials=integer(fields["trials"], "trials", 0),
        policy_version=integer(fields["policy_version"], "policy_version", -1),
        seed=integer(fields["seed"], "seed", 0),
        payload=payload,
        tasks=integer(fields["tasks"], "tasks", 1),
        first=integer(fields["first"], "first", 0),
    )


def encode_message(kind: str, **fields: object) -> bytes:
    """A small message: None, bool, int, float, str, bytes, and lists and maps of them, at most 8 deep."""
    for name in ("v", "kind"):
        if name in fields:
            raise WireError("schema", f"{name!r} names the message itself and cannot be a field")
    check_plain({"kind": kind, **fields}, "message", DEPTH)
    return pack(kind, fields)


def decode_message(data: bytes, limit: int = SMALL) -> tuple[str, dict[str, Any]]:
    """A small message's kind and fields."""
    message = unpack(data, limit)
    check_plain(message, "message", DEPTH)
    del message["v"]
    return text(message.pop("kind", None), "kind"), message


_ALWAYS = {"v", "kind"}
_TRAJECTORY = _ALWAYS | {"identity", "variation", "policy_version", "weights_digest", "worker", "origin", "arrays"}
_WEIGHTS = _ALWAYS | {"version", "digest", "arrays"}
_JOB = _ALWAYS | {
    "job",
    "stage",
    "round",
    "task",
    "variations",
    "trials",
    "policy_version",
    "seed",
    "payload",
    "tasks",
    "first",
}


def _fields(data: bytes, limit: int, kind: str, names: Set[str]) -> dict[str, Any]:
    message = unpack(data, limit)
    if message.get("kind") != kind:
        raise WireError("schema", f"kind {show(message.get('kind'))}, expected {kind!r}")
    return exactly(message, kind, names)


def _stage(value: object) -> str:
    if value not in STAGES:
        raise WireError("schema", f"stage is {show(value)}, expected one of {STAGES}")
    return text(value, "stage")


def _to_identity(value: object) -> Identity:
    stage, *numbers = as_list(value, "identity", 5)
    return Identity(_stage(stage), *(integer(n, "identity", 0, _LARGEST) for n in numbers))


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
    """The inverse of ``from_variation``, checked."""
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
    steps = len(arrays["actions"])
    wanted = {"observations": steps + 1, "rewards": steps, "adversary": steps, "labels": len(arrays["queries"])}
    wanted["gained"] = len(arrays["taken"])
    for name, rows in wanted.items():
        if len(arrays[name]) != rows:
            raise WireError("shape", f"{name} has {len(arrays[name])} rows, expected {rows}")
    if len(arrays["taken"]) > len(arrays["queries"]):
        raise WireError("shape", f"{len(arrays['taken'])} actions were taken at {len(arrays['queries'])} queries")
    if arrays["queries"].shape[1] != arrays["observations"].shape[1]:
        shapes = arrays["queries"].shape, arrays["observations"].shape
        raise WireError("shape", f"queries and observations have shapes {shapes}: different observation components")
    if arrays["actions"].ndim == 2 and len({arrays[name].shape[1] for name in ("actions", "taken", "labels")}) != 1:
        widths = {name: arrays[name].shape[1] for name in ("actions", "taken", "labels")}
        raise WireError("shape", f"vectors of actions have unlike components: {widths}")


def _check_digest(digest: str, arrays: Mapping[str, np.ndarray]) -> None:
    found = weights_digest(arrays)
    if found != digest:
        raise WireError("digest", f"these arrays hash to {found}, not to {show(digest)}")


def _hash(head: list[object], arrays: Iterable[tuple[str, np.ndarray]]) -> str:
    found = hashlib.sha256(msgpack.packb(head))
    for name, array in arrays:
        found.update(_title(name, array.dtype.str, array.shape))
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


@functools.lru_cache(maxsize=1024)
def _title(name: str, dtype: str, shape: tuple[int, ...]) -> bytes:
    packed: bytes = msgpack.packb([name, dtype, shape])
    return packed
