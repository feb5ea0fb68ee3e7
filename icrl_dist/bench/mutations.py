"""Mutations of valid messages, like those of a defective or malicious sender.

Why not hypothesis: docs/decisions/087-fuzz-mutations.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgpack
import numpy as np


def mutate(rng: np.random.Generator, valid: Sequence[bytes]) -> bytes:
    """One to three mutations of a valid input."""
    data = valid[int(rng.integers(len(valid)))]
    for _ in range(rng.integers(1, 4)):
        mutation = _MUTATIONS[rng.integers(len(_MUTATIONS))]
        data = mutation(rng, data, valid)
    return data


def _flip_bits(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(min(len(data), int(rng.integers(1, 9)))):
        changed[_position(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _truncate(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _delete(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    start = _position(rng, data)
    return data[:start] + data[start + int(rng.integers(1, 9)) :]


def _repeat(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    start = _position(rng, data)
    part = data[start : start + int(rng.integers(1, 64))]
    return data[:start] + part * int(rng.integers(2, 50)) + data[start:]


def _splice(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    other = valid[int(rng.integers(len(valid)))]
    return data[: _position(rng, data)] + other[_position(rng, other) :]


def _false_length(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    """Insert or overwrite a msgpack header with a possibly false length."""
    start, header = _position(rng, data), _header(rng, len(data))
    return data[:start] + header + data[start + int(rng.integers(2)) * len(header) :]


def _header(rng: np.random.Generator, size: int) -> bytes:
    """The header of a msgpack value with a possibly false length; sometimes repeated, which nests it."""
    width = int(rng.choice([0, 1, 2, 4]))
    kind = _KINDS[width][int(rng.integers(len(_KINDS[width])))]
    length = int(rng.choice([0, 1, 127, size // 2, size, 1 << 14, 2**16 - 1, 2**31, 2**32 - 1]))
    header = bytes([kind]) + min(length, 256**width - 1).to_bytes(width)
    return header * int(rng.choice([1, 1, 10, 500]))


def _noise(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    return rng.bytes(int(rng.integers(200)))


def _replace_value(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    """Replace, rename or remove one value of the message, at any depth."""
    message, place = _parse_and_pick(rng, data)
    if place is None:
        return _random_value(rng, data, valid)
    holder, key = place
    choice = rng.random()
    if isinstance(holder, dict) and choice < 0.1:
        holder[_scalar(rng)] = holder.pop(key)
    elif choice < 0.2:
        holder.pop(key)
    else:
        holder[key] = _value(rng, 3)
    return _pack(message)


def _nested_false_length(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    """Replace one value of the message by headers with possibly false lengths."""
    message, place = _parse_and_pick(rng, data)
    if place is None:
        return _false_length(rng, data, valid)
    place[0][place[1]] = _MARK
    return _pack(message).replace(_pack(_MARK), _header(rng, len(data)))


def _parse_and_pick(rng: np.random.Generator, data: bytes) -> tuple[Any, tuple[Any, Any] | None]:
    """The parsed message and a random (container, key) in it; None if an earlier mutation made it unreadable."""
    try:
        message = msgpack.unpackb(data, strict_map_key=False)
    except Exception:
        return None, None
    return message, _place(rng, message)


def _random_value(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    return _pack(_value(rng, 4))


def _position(rng: np.random.Generator, data: bytes) -> int:
    """A position in the data; half of the time near the start or the end, where there are fields other than array data."""
    last = max(0, len(data) - 1)
    close = min(last, int(rng.integers(400)))
    return int(rng.choice([close, last - close, int(rng.integers(last + 1)), int(rng.integers(last + 1))]))


def _place(rng: np.random.Generator, value: Any) -> tuple[Any, Any] | None:
    """A random container within a value, and a key or an index of it."""
    found = None
    while isinstance(value, (dict, list)) and len(value) and (found is None or rng.random() < 0.7):
        keys = list(value) if isinstance(value, dict) else range(len(value))
        found = value, keys[int(rng.integers(len(keys)))]
        value = found[0][found[1]]
    return found


def _value(rng: np.random.Generator, depth: int) -> Any:
    kind = rng.integers(8)
    if depth and kind == 0:
        return [_value(rng, depth - 1) for _ in range(rng.integers(6))]
    if depth and kind == 1:
        return {_scalar(rng): _value(rng, depth - 1) for _ in range(rng.integers(4))}
    if depth and kind == 2:
        return [[]] * int(20_000 ** rng.random())
    return _scalar(rng)


def _scalar(rng: np.random.Generator) -> Any:
    return _SCALARS[rng.integers(len(_SCALARS))]


def _pack(value: Any) -> bytes:
    packed: bytes = msgpack.packb(value, unicode_errors="surrogatepass")
    return packed


_SCALARS: list[Any] = [None, True, False, 0, -1, 1, 127, 2**31, 2**63, 2**64 - 1, -(2**63), float("nan"), float("inf"), -0.0]
_SCALARS += ["", "a", "é", "\ud800", "x" * 300, "<f4", "|O", "<f8", "adapt", "v", "kind", b"", b"\xff" * 5, b"\0" * 1000]
_SCALARS += [msgpack.ExtType(1, b"x"), msgpack.Timestamp(0)]

_MARK = b"in the place of this"
_KINDS = {
    0: b"\x80\x8f\x90\x91\x9f\xa0\xbf\xc0\xc1\xca\xcb\xcf\xd3\xd4\xd8",
    1: b"\xc4\xc7\xd9",
    2: b"\xc5\xc8\xda\xdc\xde",
    4: b"\xc6\xc9\xdb\xdd\xdf",
}
"""Type bytes of msgpack, by the width of the length that follows."""

_MUTATIONS = (
    _flip_bits,
    _truncate,
    _delete,
    _repeat,
    _splice,
    _false_length,
    _nested_false_length,
    _nested_false_length,
    _noise,
    _replace_value,
    _replace_value,
    _replace_value,
    _random_value,
)
