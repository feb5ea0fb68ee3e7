"""The bytes that travel: msgpack maps with a version, checked field by field, read without pickle.

An array is ``[dtype, shape, bytes]``.  Whatever is wrong with a message, in either direction,
raises :class:`WireError` with one of the reasons in ``REASONS``; nothing else is raised.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Set
from typing import Any, NoReturn, TypeVar

import msgpack
import numpy as np

from icrl_dist.types import ARRAYS, STAGES, Adversary, Identity, Job, Params, Task, Trajectory, Value, Variation, Weights

_T = TypeVar("_T")

VERSION = 1
"""Version of every message; a reader refuses all others."""

REASONS: dict[str, str] = {
    "oversized": "longer than the reader's limit",
    "not-msgpack": "not exactly one msgpack value of plain types",
    "version": "written by another version of the wire",
    "schema": "a field is missing, unknown, of the wrong type or out of range",
    "dtype": "an array of a dtype that does not belong there",
    "shape": "an array whose shape disagrees with its bytes, its rank or its companions",
    "digest": "weights that do not hash to the digest they came with",
}
"""Every reason of a :class:`WireError`, fit to count drops by."""

WEIGHT_DTYPES = frozenset({"<f2", "<f4", "<f8", "<i4", "<i8", "|u1"})
"""Dtypes that a model's parameters may have."""

SMALL = 1 << 20
"""Default limit of jobs and messages, bytes."""

_ITEMS = 1 << 14
_DEPTH = 8
_CELLS = 1 << 31
_TEXT = 1 << 16


class WireError(ValueError):
    """A message that is not what it should be; ``reason`` is a key of ``REASONS``."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def encode_trajectory(trajectory: Trajectory) -> bytes:
    """The trajectory as bytes.  The producer's mistakes are refused here, as the reader would refuse them."""
    arrays = trajectory.arrays()
    for name, array in arrays.items():
        _check_kind(name, array.dtype.str, array.ndim)
    _check_lengths(arrays)
    return _pack(
        "trajectory",
        {
            "identity": list(trajectory.identity),
            "variation": _from_variation(trajectory.variation),
            "weights": trajectory.weights,
            "digest": trajectory.digest,
            "worker": trajectory.worker,
            "origin": trajectory.origin,
            "arrays": {name: _from_array(array) for name, array in arrays.items()},
        },
    )


def decode_trajectory(data: bytes, limit: int) -> Trajectory:
    """The trajectory in ``data``, of at most ``limit`` bytes; its arrays are read-only views.

    What the arrays hold (finiteness, the environment's bounds) is not the wire's to judge.
    """
    fields = _fields(data, limit, "trajectory", _TRAJECTORY)
    raw = _exactly(fields["arrays"], "arrays", ARRAYS.keys())
    arrays = {}
    for name, (dtype, ndim) in ARRAYS.items():
        arrays[name] = _to_array(name, raw[name], (dtype,), ndim)
    _check_lengths(arrays)
    return Trajectory(
        identity=_to_identity(fields["identity"]),
        variation=_to_variation(fields["variation"]),
        weights=_integer(fields["weights"], "weights", -1),
        digest=_text(fields["digest"], "digest"),
        worker=_text(fields["worker"], "worker"),
        origin=_text(fields["origin"], "origin"),
        **arrays,
    )


def trajectory_digest(trajectory: Trajectory) -> str:
    """SHA-256 of all that a trajectory says, hexadecimal; the same whichever worker made it."""
    head = [
        list(trajectory.identity),
        _from_variation(trajectory.variation),
        trajectory.weights,
        trajectory.digest,
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
    return _pack(
        "weights",
        {
            "version": weights.version,
            "digest": weights.digest,
            "arrays": {name: _from_array(array) for name, array in weights.arrays.items()},
        },
    )


def decode_weights(data: bytes, limit: int) -> Weights:
    """The weights in ``data``, of at most ``limit`` bytes, if they hash to the digest they came with."""
    fields = _fields(data, limit, "weights", _WEIGHTS)
    arrays = {_text(n, "arrays"): _to_array(n, a, WEIGHT_DTYPES, None) for n, a in _map(fields["arrays"], "arrays").items()}
    digest = _text(fields["digest"], "digest")
    _check_digest(digest, arrays)
    return Weights(_integer(fields["version"], "version", 0), arrays, digest)


def encode_job(job: Job) -> bytes:
    """The job as bytes."""
    return _pack(
        "job",
        {
            "job": job.kind,
            "stage": job.stage,
            "round": job.round,
            "task": job.task,
            "variations": [_from_variation(v) for v in job.variations],
            "trials": job.trials,
            "weights": job.weights,
            "seed": job.seed,
            "settings": _from_params(job.settings),
            "tasks": job.tasks,
        },
    )


def decode_job(data: bytes, limit: int = SMALL) -> Job:
    """The job in ``data``, equal to the one encoded: integers stay integers, lists come back as tuples."""
    fields = _fields(data, limit, "job", _JOB)
    return Job(
        kind=_text(fields["job"], "job"),
        stage=_stage(fields["stage"]),
        round=_integer(fields["round"], "round", 0),
        task=_integer(fields["task"], "task", 0),
        variations=tuple(_to_variation(v) for v in _list(fields["variations"], "variations")),
        trials=_integer(fields["trials"], "trials", 0),
        weights=_integer(fields["weights"], "weights", -1),
        seed=_integer(fields["seed"], "seed", 0),
        settings=_to_params(fields["settings"], "settings"),
        tasks=_integer(fields["tasks"], "tasks", 1),
    )


def encode_message(kind: str, **fields: object) -> bytes:
    """A small message: None, bool, int, float, str, bytes, and lists and maps of them, at most 8 deep."""
    for name in ("v", "kind"):
        if name in fields:
            raise WireError("schema", f"{name!r} names the message itself and cannot be a field")
    _check_plain({"kind": kind, **fields}, "message", _DEPTH)
    return _pack(kind, fields)


def decode_message(data: bytes, limit: int = SMALL) -> tuple[str, dict[str, Any]]:
    """A small message's kind and fields."""
    message = _unpack(data, limit)
    _check_plain(message, "message", _DEPTH)
    del message["v"]
    return _text(message.pop("kind", None), "kind"), message


def monitor_trajectory(trajectory: Trajectory, time: float) -> bytes:
    """What the monitor plane says of a trajectory: docs/tap.md.  ``time`` in Unix seconds."""
    return encode_message(
        "trajectory",
        identity=str(trajectory.identity),
        problem=trajectory.variation.task.kind,
        task=_plain(trajectory.variation.task.params),
        adversary={**_plain(trajectory.variation.adversary.params), "kind": trajectory.variation.adversary.kind},
        episode_return=trajectory.episode_return,
        steps=len(trajectory.actions),
        weights=trajectory.weights,
        digest=trajectory.digest,
        worker=trajectory.worker,
        time=float(time),
    )


_ALWAYS = {"v", "kind"}
_TRAJECTORY = _ALWAYS | {"identity", "variation", "weights", "digest", "worker", "origin", "arrays"}
_WEIGHTS = _ALWAYS | {"version", "digest", "arrays"}
_JOB = _ALWAYS | {"job", "stage", "round", "task", "variations", "trials", "weights", "seed", "settings", "tasks"}
_DTYPES = {name: np.dtype(name) for name in WEIGHT_DTYPES | {dtype for dtype, _ in ARRAYS.values()}}


def _pack(kind: str, fields: Mapping[str, object]) -> bytes:
    try:
        packed: bytes = msgpack.packb({"v": VERSION, "kind": kind, **fields}, use_bin_type=True)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError("schema", f"{kind} holds what msgpack cannot: {error}") from error
    return packed


def _unpack(data: bytes, limit: int) -> dict[str, Any]:
    if len(data) > limit:
        raise WireError("oversized", f"{len(data)} bytes, the limit is {limit}")
    try:
        message = msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,
            ext_hook=_no_extension,
            max_str_len=min(len(data), _TEXT),
            max_bin_len=len(data),
            max_array_len=min(len(data), _ITEMS),
            max_map_len=min(len(data), _ITEMS),
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError("not-msgpack", f"{type(error).__name__}: {error}") from error
    message = _map(message, "message")
    version = message.get("v")
    if type(version) is not int or version != VERSION:
        raise WireError("version", f"version {version!r}, this side reads {VERSION}: install the same release on both sides")
    return message


def _no_extension(code: int, data: bytes) -> NoReturn:
    raise ValueError(f"extension type {code}")


def _fields(data: bytes, limit: int, kind: str, names: Set[str]) -> dict[str, Any]:
    message = _unpack(data, limit)
    if message.get("kind") != kind:
        raise WireError("schema", f"kind {_show(message.get('kind'))}, expected {kind!r}")
    return _exactly(message, kind, names)


def _exactly(value: object, what: str, names: Set[str]) -> dict[str, Any]:
    found = _map(value, what)
    if found.keys() != names:
        odd = names ^ found.keys()
        raise WireError("schema", f"{what}: missing or unknown {_show(sorted(map(str, odd)))}")
    return found


def _show(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _typed(value: object, kind: type[_T], what: str) -> _T:
    if type(value) is not kind:
        raise WireError("schema", f"{what} is {_show(value)}, expected {kind.__name__}")
    return value


def _map(value: object, what: str) -> dict[str, Any]:
    found: dict[str, Any] = _typed(value, dict, what)
    for name in found:
        if type(name) is not str:
            raise WireError("schema", f"{what} has the key {_show(name)}, expected text")
    return found


def _list(value: object, what: str, length: int | None = None) -> list[Any]:
    if type(value) is not list:
        raise WireError("schema", f"{what} is {_show(value)}, expected list")
    if length is not None and len(value) != length:
        raise WireError("schema", f"{what} has {len(value)} entries, expected {length}")
    return value


def _text(value: object, what: str) -> str:
    return _typed(value, str, what)


def _integer(value: object, what: str, low: int) -> int:
    found = _typed(value, int, what)
    if found < low:
        raise WireError("schema", f"{what} is {found}, expected at least {low}")
    return found


def _stage(value: object) -> str:
    if value not in STAGES:
        raise WireError("schema", f"stage is {_show(value)}, expected one of {STAGES}")
    return _text(value, "stage")


def _to_identity(value: object) -> Identity:
    stage, *numbers = _list(value, "identity", 5)
    return Identity(_stage(stage), *(_integer(n, "identity", 0) for n in numbers))


def _from_params(params: Params) -> list[object]:
    return [[name, list(value) if isinstance(value, tuple) else value] for name, value in params]


def _plain(params: Params) -> dict[str, object]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in params}


def _to_params(value: object, what: str) -> Params:
    pairs = (_list(pair, what, 2) for pair in _list(value, what))
    return tuple((_text(name, what), _to_value(v, what)) for name, v in pairs)


def _to_value(value: object, what: str) -> Value:
    if isinstance(value, (bool, int, float, str)):
        return value
    numbers = _list(value, what)
    for number in numbers:
        if not isinstance(number, (int, float)):
            raise WireError("schema", f"{what} holds {_show(number)}, expected numbers")
    return tuple(numbers)


def _from_variation(variation: Variation) -> list[object]:
    return [[named.kind, _from_params(named.params)] for named in (variation.task, variation.adversary)]


def _to_variation(value: object) -> Variation:
    (task, of_task), (adversary, of_adversary) = (_list(named, "variation", 2) for named in _list(value, "variation", 2))
    return Variation(
        Task(_text(task, "task"), _to_params(of_task, "task")),
        Adversary(_text(adversary, "adversary"), _to_params(of_adversary, "adversary")),
    )


def _from_array(array: np.ndarray) -> list[object]:
    return [array.dtype.str, list(array.shape), array.tobytes()]


def _to_array(name: str, value: object, dtypes: Iterable[str], ndim: int | None) -> np.ndarray:
    dtype, shape, content = _list(value, name, 3)
    if type(dtype) is not str or dtype not in dtypes:
        raise WireError("dtype", f"{name} is {_show(dtype)}, expected one of {sorted(dtypes)}")
    if type(content) is not bytes:
        raise WireError("schema", f"{name}'s content is {_show(content)}, expected bytes")
    cells = extent = 1
    for size in _list(shape, name):
        if type(size) is not int or size < 0:
            raise WireError("schema", f"{name} has shape {_show(shape)}, expected whole numbers")
        cells *= size
        extent *= size or 1
    if len(shape) > _DEPTH or extent > _CELLS or (ndim is not None and len(shape) != ndim):
        raise WireError("shape", f"{name} has shape {_show(shape)}, expected {ndim or 'few'} dimensions")
    kind = _DTYPES[dtype]
    if cells * kind.itemsize != len(content):
        raise WireError("shape", f"{name} has shape {shape} of {dtype} but {len(content)} bytes")
    return np.frombuffer(content, kind).reshape(shape)


def _check_kind(name: str, dtype: str, ndim: int) -> None:
    expected, rank = ARRAYS[name]
    if dtype != expected:
        raise WireError("dtype", f"{name} is {dtype}, expected {expected}")
    if ndim != rank:
        raise WireError("shape", f"{name} has {ndim} dimensions, expected {rank}")


def _check_lengths(arrays: Mapping[str, np.ndarray]) -> None:
    steps = len(arrays["actions"])
    wanted = {"observations": steps + 1, "rewards": steps, "adversary": steps, "labels": len(arrays["queries"])}
    for name, rows in wanted.items():
        if len(arrays[name]) != rows:
            raise WireError("shape", f"{name} has {len(arrays[name])} rows, expected {rows}")
    if arrays["queries"].shape[1] != arrays["observations"].shape[1]:
        shapes = arrays["queries"].shape, arrays["observations"].shape
        raise WireError("shape", f"queries and observations have shapes {shapes}: different observation components")


def _check_digest(digest: str, arrays: Mapping[str, np.ndarray]) -> None:
    found = weights_digest(arrays)
    if found != digest:
        raise WireError("digest", f"these arrays hash to {found}, not to {_show(digest)}")


def _check_plain(value: object, where: str, depth: int) -> None:
    if value is None or isinstance(value, (bool, int, float, str, bytes)):
        if type(value).__module__ != "builtins":
            raise WireError("schema", f"{where} is a {type(value).__module__}.{type(value).__name__}: convert it first")
    elif depth == 0:
        raise WireError("schema", f"{where} is nested deeper than {_DEPTH}")
    elif isinstance(value, dict):
        for name, item in value.items():
            if type(name) is not str:
                raise WireError("schema", f"{where} has the key {_show(name)}, expected strings")
            _check_plain(item, f"{where}.{name}", depth - 1)
    elif isinstance(value, list):
        for item in value:
            _check_plain(item, f"{where}[]", depth - 1)
    else:
        raise WireError("schema", f"{where} is {_show(value)}: not a plain value")


def _hash(head: list[object], arrays: Iterable[tuple[str, np.ndarray]]) -> str:
    found = hashlib.sha256(msgpack.packb(head))
    for name, array in arrays:
        found.update(msgpack.packb([name, array.dtype.str, list(array.shape)]))
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()
