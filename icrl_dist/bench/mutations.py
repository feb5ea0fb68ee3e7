"""Changes to valid messages, such as a broken or a hostile sender might make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgpack
import numpy as np


def mutate(rng: np.random.Generator, valid: Sequence[bytes]) -> bytes:
    """An input: one to three changes to a valid one, or nothing but noise."""
    data = valid[int(rng.integers(len(valid)))]
    for _ in range(rng.integers(1, 4)):
        change = _CHANGES[rng.integers(len(_CHANGES))]
        data = change(rng, data, valid)
    return data


def _flip(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(min(len(data), int(rng.integers(1, 9)))):
        changed[_near(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _drop(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    start = _near(rng, data)
    return data[:start] + data[start + int(rng.integers(1, 9)) :]


def _repeat(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    start = _near(rng, data)
    part = data[start : start + int(rng.integers(1, 64))]
    return data[:start] + part * int(rng.integers(2, 50)) + data[start:]


def _splice(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    other = valid[int(rng.integers(len(valid)))]
    return data[: _near(rng, data)] + other[_near(rng, other) :]


def _lie(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    """A length that need not be true, over or between what was there."""
    start, lie = _near(rng, data), _head(rng, len(data))
    return data[:start] + lie + data[start + int(rng.integers(2)) * len(lie) :]


def _head(rng: np.random.Generator, size: int) -> bytes:
    """The first bytes of a value for msgpack, with a length about which it may lie; perhaps many within each other."""
    width = int(rng.choice([0, 1, 2, 4]))
    kind = _KINDS[width][int(rng.integers(len(_KINDS[width])))]
    length = int(rng.choice([0, 1, 127, size // 2, size, 1 << 14, 2**16 - 1, 2**31, 2**32 - 1]))
    head = bytes([kind]) + min(length, 256**width - 1).to_bytes(width)
    return head * int(rng.choice([1, 1, 10, 500]))


def _noise(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    return rng.bytes(int(rng.integers(200)))


def _strange(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    """The same message with one of its values, wherever it lies, replaced by a strange one, renamed or left out."""
    message, place = _somewhere(rng, data)
    if place is None:
        return _plain(rng, data, valid)
    holder, key = place
    chance = rng.random()
    if isinstance(holder, dict) and chance < 0.1:
        holder[_scalar(rng)] = holder.pop(key)
    elif chance < 0.2:
        holder.pop(key)
    else:
        holder[key] = _value(rng, 3)
    return _pack(message)


def _claim(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    """The same message with lengths that need not be true, perhaps within each other, in a value's place."""
    message, place = _somewhere(rng, data)
    if place is None:
        return _lie(rng, data, valid)
    place[0][place[1]] = _MARK
    return _pack(message).replace(_pack(_MARK), _head(rng, len(data)))


def _somewhere(rng: np.random.Generator, data: bytes) -> tuple[Any, tuple[Any, Any] | None]:
    """The message, and a container in it with a key or an index; None if it is none, for an earlier change broke it."""
    try:
        message = msgpack.unpackb(data, strict_map_key=False)
    except Exception:
        return None, None
    return message, _place(rng, message)


def _plain(rng: np.random.Generator, data: bytes, valid: Sequence[bytes]) -> bytes:
    return _pack(_value(rng, 4))


def _near(rng: np.random.Generator, data: bytes) -> int:
    """A place in the data; half of the time near its start or its end, where there is more than numbers."""
    last = max(0, len(data) - 1)
    close = min(last, int(rng.integers(400)))
    return int(rng.choice([close, last - close, int(rng.integers(last + 1)), int(rng.integers(last + 1))]))


def _place(rng: np.random.Generator, value: Any) -> tuple[Any, Any] | None:
    """A container somewhere within a value, and a key or an index of it."""
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

_CHANGES = (_flip, _cut, _drop, _repeat, _splice, _lie, _claim, _claim, _noise, _strange, _strange, _strange, _plain)
