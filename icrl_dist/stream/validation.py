"""Decoding of untrusted bytes: every field is checked, sizes are bounded, nothing is executed.

Every error is a :class:`WireError` with one of the reasons in ``REASONS``.  Maps with fixed fields
are dataclasses that ``read`` decodes (``schema``); the functions here check what has no fixed
fields: the bytes themselves, arrays, and free-form values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Set
from typing import Annotated, Any, Literal, NoReturn, TypeVar

import msgpack
import numpy as np
from annotated_types import Ge

from icrl_dist.stream import schema
from icrl_dist.stream.excerpts import show
from icrl_dist.types import ARRAYS

_T = TypeVar("_T")

VERSION = 2
"""Version of the wire format and of the dataset, in every message and checkpoint.

Messages of other versions are refused; runs of other versions can be evaluated, but not continued."""

REASONS: dict[str, str] = {
    "oversized": "longer than the reader's limit",
    "not-msgpack": "not exactly one msgpack value of plain types",
    "version": "written by another version of the wire format",
    "schema": "a field is missing, unknown, of the wrong type or out of range",
    "dtype": "an array of a dtype that is not allowed there",
    "shape": "an array whose shape does not fit its bytes, its rank or the other arrays",
    "digest": "weights whose SHA-256 is not the digest in the message",
}
"""Every reason of a :class:`WireError`; the learner counts dropped messages by reason."""

WEIGHT_DTYPES = frozenset({"<f2", "<f4", "<f8", "<i4", "<i8", "|u1"})
"""Dtypes allowed for a model's parameters."""

Count = Annotated[int, Ge(0)]
Stage = Literal["pretrain", "adapt", "evaluate"]
"""The values of ``types.STAGES``."""

_ITEMS = 1 << 14
_VALUES = 1 << 16
DEPTH = 8
_CELLS = 1 << 31
_TEXT = 1 << 16

_DTYPES = {name: np.dtype(name) for name in WEIGHT_DTYPES | {dtype for dtype, _ in ARRAYS.values()}}


class WireError(ValueError):
    """A message that is not valid; ``reason`` is a key of ``REASONS``."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def pack(kind: str, fields: Mapping[str, object]) -> bytes:
    """The fields as a message of this version.  Raises WireError for values that msgpack cannot hold."""
    try:
        packed: bytes = msgpack.packb({"v": VERSION, "kind": kind, **fields}, use_bin_type=True)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError("schema", f"{kind} has a value that msgpack cannot hold: {error}") from error
    return packed


def unpack(data: bytes, limit: int) -> dict[str, Any]:
    """Decode ``data``, of at most ``limit`` bytes, as one msgpack map of this version."""
    if len(data) > limit:
        raise WireError("oversized", f"{len(data)} bytes, the limit is {limit}")
    message = as_map(parse(data), "message")
    version = message.get("v")
    if type(version) is not int or version != VERSION:
        raise WireError("version", f"version {show(version)}, expected {VERSION}: install the same release on both sides")
    return message


def parse(data: bytes) -> object:
    """Decode ``data`` as one msgpack value.  Takes at most 16 times its length and 8 MiB of memory."""
    # msgpack allocates as many entries as an array's header states before it reads them: a thousand
    # nested headers, 3 KB, allocate 130 MB.  skip() allocates nothing and fails if entries are missing.
    reader = msgpack.Unpacker(max_buffer_size=max(1, len(data)), read_size=max(1, len(data)))
    # An empty list takes 64 bytes of memory and one byte of the message, so values are counted.
    count = _counter(_VALUES + len(data) // 8) if len(data) > _VALUES else None
    try:
        reader.feed(data)
        reader.skip()
        return msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,
            list_hook=count,
            object_hook=count,
            ext_hook=no_extension,
            max_str_len=min(len(data), _TEXT),
            max_bin_len=len(data),
            max_array_len=min(len(data), _ITEMS),
            max_map_len=min(len(data), _ITEMS),
            max_ext_len=0,
        )
    except WireError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError("not-msgpack", f"{type(error).__name__}: {error}") from error


def _counter(most: int) -> Callable[[Any], Any]:
    left = most

    def count(found: Any) -> Any:
        nonlocal left
        left -= len(found) * (2 if isinstance(found, dict) else 1)
        if left < 0:
            raise WireError("oversized", f"more than {most} values")
        return found

    return count


def no_extension(code: int, data: bytes) -> NoReturn:
    """The ``ext_hook`` for msgpack: refuse every extension type."""
    raise ValueError(f"extension type {code}")


def exactly(value: object, what: str, names: Set[str]) -> dict[str, Any]:
    """``value`` as a map with exactly these names."""
    found = as_map(value, what)
    if found.keys() != names:
        odd = names ^ found.keys()
        raise WireError("schema", f"{what}: missing or unknown {show(sorted(map(str, odd)))}")
    return found


def read(cls: type[_T], fields: object, where: str = "") -> _T:
    """A map with fixed fields as the dataclass ``cls``.  Raises WireError if the fields do not fit."""
    try:
        return schema.read(cls, fields, where)
    except schema.Invalid as error:
        raise WireError("schema", str(error)) from None


def typed(value: object, kind: type[_T], what: str) -> _T:
    """``value``, which must be exactly of this type."""
    if type(value) is not kind:
        raise WireError("schema", f"{what} is {show(value)}, expected {kind.__name__}")
    return value


def as_map(value: object, what: str) -> dict[str, Any]:
    """``value`` as a map whose keys are text."""
    found: dict[str, Any] = typed(value, dict, what)
    for name in found:
        if type(name) is not str:
            raise WireError("schema", f"{what} has the key {show(name)}, expected text")
    return found


def as_list(value: object, what: str, length: int | None = None) -> list[Any]:
    """``value`` as a list; with ``length``, as a list of that length."""
    if type(value) is not list:
        raise WireError("schema", f"{what} is {show(value)}, expected list")
    if length is not None and len(value) != length:
        raise WireError("schema", f"{what} has {len(value)} entries, expected {length}")
    return value


def text(value: object, what: str) -> str:
    """``value`` as text."""
    return typed(value, str, what)


def integer(value: object, what: str, low: int, high: int | None = None) -> int:
    """``value`` as an integer of at least ``low`` and at most ``high``."""
    found = typed(value, int, what)
    if found < low:
        raise WireError("schema", f"{what} is {found}, expected at least {low}")
    if high is not None and found > high:
        raise WireError("schema", f"{what} is {found}, expected at most {high}")
    return found


def from_array(array: np.ndarray) -> list[object]:
    """An array as ``[dtype, shape, bytes]``."""
    return [array.dtype.str, list(array.shape), array.tobytes()]


def to_array(name: str, value: object, dtypes: Iterable[str], ndim: int | None) -> np.ndarray:
    """Decode what ``from_array`` gives, without a copy; the array is read-only.  Refuses other dtypes and ranks."""
    dtype, shape, content = as_list(value, name, 3)
    if type(dtype) is not str or dtype not in dtypes:
        raise WireError("dtype", f"{name} is {show(dtype)}, expected one of {sorted(dtypes)}")
    if type(content) is not bytes:
        raise WireError("schema", f"{name} has the content {show(content)}, expected bytes")
    cells = extent = 1
    for size in as_list(shape, name):
        if type(size) is not int or size < 0:
            raise WireError("schema", f"{name} has shape {show(shape)}, expected integers of at least 0")
        cells *= size
        extent *= size or 1
    if len(shape) > DEPTH or extent > _CELLS or (ndim is not None and len(shape) != ndim):
        raise WireError("shape", f"{name} has shape {show(shape)}, expected {ndim or 'few'} dimensions")
    kind = _DTYPES[dtype]
    if cells * kind.itemsize != len(content):
        raise WireError("shape", f"{name} has shape {shape} of {dtype} but {len(content)} bytes")
    return np.frombuffer(content, kind).reshape(shape)


def check_plain(value: object, where: str, depth: int) -> None:
    """Refuse everything but None, bool, int, float, str, bytes, and lists and maps of these, ``depth`` deep."""
    if value is None or isinstance(value, (bool, int, float, str, bytes)):
        if type(value).__module__ != "builtins":
            raise WireError("schema", f"{where} is a {type(value).__module__}.{type(value).__name__}: convert it first")
    elif depth == 0:
        raise WireError("schema", f"{where} is nested deeper than {DEPTH}")
    elif isinstance(value, dict):
        for name, item in value.items():
            if type(name) is not str:
                raise WireError("schema", f"{where} has the key {show(name)}, expected strings")
            check_plain(item, f"{where}.{name}", depth - 1)
    elif isinstance(value, list):
        for item in value:
            check_plain(item, f"{where}[]", depth - 1)
    else:
        raise WireError("schema", f"{where} is {show(value)}: expected None, a bool, number, text, bytes, list or map")
