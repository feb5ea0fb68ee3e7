"""The format of a segment file: a sequence of frames with checksums.

A frame is a header ``magic, length, checksum of the payload, checksum of the header`` and a payload:

- a *name*: ``[number, value]``, a variation or a text to which later trajectories refer by number;
- a *trajectory*: small integers (identity, numbers of names, shapes), then its arrays' bytes;
- a *seal*: SHA-256 of everything before it, at the end of a finished segment.

The third byte of ``magic`` is the number of the format.  The header's own checksum lets a reader find the next
intact frame after a damaged one.
"""

from __future__ import annotations

import hashlib
import itertools
import mmap
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import msgpack
import numpy as np

from icrl_dist.stream import validation, wire
from icrl_dist.types import ARRAYS, STAGES, VECTORS, Identity, Trajectory, Variation

_HEADER = struct.Struct("<4sIII")
_HEAD, _CHECKSUM = struct.Struct("<4sII"), struct.Struct("<I")
FORMAT = 2
"""Number of the format, 1 to 9.  Segments of another number are refused: their trajectories have other digests."""
_FIRST = b"r"
"""The third byte of format 1, which had no digit there."""
_PREFIX = b"ic"
NAME, TRAJECTORY, SEAL = (b"%b%d%b" % (_PREFIX, FORMAT, kind) for kind in (b"N", b"T", b"S"))
HEADER_BYTES = _HEADER.size
SEAL_BYTES = HEADER_BYTES + 32
_NUMBERS = 15
_DTYPES, _VECTOR_DTYPES = ({name: np.dtype(dtype) for name, (dtype, _) in kinds.items()} for kinds in (ARRAYS, VECTORS))


def frame(magic: bytes, payload: bytes) -> bytes:
    """A frame with this payload."""
    head = _HEAD.pack(magic, len(payload), zlib.crc32(payload))
    return head + _CHECKSUM.pack(zlib.crc32(head)) + payload


class MissingName(ValueError):  # noqa: N818
    """A frame refers to a name whose frame was damaged."""


class OtherFormat(ValueError):  # noqa: N818
    """A segment was written in another format; the message names both numbers and the remedy."""


@dataclass
class Names:
    """The names of one segment: variations and texts, each written once and referred to by its number."""

    values: dict[int, Variation | str] = field(default_factory=dict)
    _numbers: dict[bytes | str, int] = field(default_factory=dict)
    _next: int = 0

    def number(self, value: Variation | str) -> tuple[int, bytes]:
        """The value's number, and the frame to write first; empty if the value has a number already."""
        # The packed bytes differ where Python's equality does not: 0 and 0.0.
        key = value if isinstance(value, str) else msgpack.packb(wire.from_variation(value))
        known = self._numbers.get(key)
        if known is not None:
            return known, b""
        number = self._next
        self._set(number, value, key)
        return number, frame(NAME, msgpack.packb(number) + (msgpack.packb(key) if isinstance(key, str) else key))

    def read(self, payload: bytes) -> None:
        """Read a name frame.  Raises ValueError for an invalid payload."""
        reader = _reader(payload[:16])
        number = validation.integer(_next(reader), "name", 0)
        packed = payload[reader.tell() :]
        plain = validation.parse(packed)
        value = plain if isinstance(plain, str) else wire.to_variation(plain)
        self._set(number, value, value if isinstance(value, str) else packed)

    def _set(self, number: int, value: Variation | str, key: bytes | str) -> None:
        self.values[number], self._numbers[key] = value, number
        self._next = max(self._next, number + 1)

    def variation(self, number: int) -> Variation:
        """The name of this number.  Raises MissingName if there is none."""
        found = self.values.get(number)
        if not isinstance(found, Variation):
            raise MissingName(f"variation {number} of this segment is missing")
        return found

    def text(self, number: int) -> str:
        """The name of this number.  Raises MissingName if there is none."""
        found = self.values.get(number)
        if not isinstance(found, str):
            raise MissingName(f"text {number} of this segment is missing")
        return found


def encode(trajectory: Trajectory, names: Names) -> tuple[bytes, bytes]:
    """The frames to write: those of names that are new in this segment, and that of the trajectory."""
    t, new_names, numbers = trajectory, [], []
    for value in (t.variation, t.weights_digest, t.worker, t.origin):
        number, new = names.number(value)
        numbers.append(number)
        new_names.append(new)
    shape = (len(t.actions), t.observations.shape[1], len(t.queries), t.labels.shape[1], len(t.prev_actions))
    adversary_width = () if t.adversary.ndim == 1 else (t.adversary.shape[1],)
    head = msgpack.packb([*t.identity.key(), t.policy_version, *numbers, *shape, *adversary_width])
    return b"".join(new_names), frame(TRAJECTORY, b"".join((head, *(array.tobytes() for array in t.arrays().values()))))


def decode(payload: bytes, names: Names) -> Trajectory:
    """The trajectory in a frame's payload; its arrays are views of the payload.

    Raises ValueError for an invalid payload, MissingName if the frame of one of its names was damaged.
    """
    reader = _reader(payload[:256])
    numbers = [validation.integer(n, "frame", -1) for n in validation.as_list(_next(reader), "frame")]
    vectors = len(numbers) == _NUMBERS + 1  # the last one is the number of the adversary's components
    if len(numbers) != _NUMBERS and not vectors:
        raise ValueError(f"a trajectory frame has {len(numbers)} numbers, expected {_NUMBERS} or {_NUMBERS + 1}")
    adversary_width = numbers.pop() if vectors else 0
    stage, round_, task, variation, trial, version, phi, digest, worker, origin, *sizes = numbers
    steps, components, queries, actions, window_steps = sizes
    if (
        min(numbers[:5] + numbers[6:] + [adversary_width]) < 0
        or max(*numbers, adversary_width) >= 1 << 31
        or stage >= len(STAGES)
    ):
        raise ValueError(f"a trajectory frame has the numbers {numbers}, out of range")
    width = (actions,) if vectors else ()
    shapes = {
        "observations": (steps + 1, components),
        "actions": (steps, *width),
        "rewards": (steps,),
        "adversary": (steps, adversary_width) if vectors else (steps,),
        "queries": (queries, components),
        "labels": (queries, actions),
        "prev_actions": (window_steps, *width),
        "prev_rewards": (window_steps,),
    }
    arrays, at, dtypes = {}, reader.tell(), _VECTOR_DTYPES if vectors else _DTYPES
    if len(payload) - at != sum(prod(shape) * dtypes[name].itemsize for name, shape in shapes.items()):
        raise ValueError(f"a trajectory frame has {len(payload)} bytes, which do not fit the shapes {shapes}")
    for name, dtype in dtypes.items():
        count = prod(shapes[name])
        arrays[name] = np.frombuffer(payload, dtype, count, at).reshape(shapes[name])
        at += count * dtype.itemsize
    return Trajectory(
        identity=Identity(STAGES[stage], round_, task, variation, trial),
        variation=names.variation(phi),
        policy_version=version,
        weights_digest=names.text(digest),
        worker=names.text(worker),
        origin=names.text(origin),
        **arrays,
    )


def _reader(payload: bytes) -> msgpack.Unpacker:
    """A msgpack reader of integers and short lists; its limits bound the memory that a false list length can take."""
    reader = msgpack.Unpacker(
        max_buffer_size=max(1, len(payload)),
        max_array_len=_NUMBERS + 1,
        max_map_len=0,
        max_str_len=0,
        max_bin_len=0,
        max_ext_len=0,
        ext_hook=validation.no_extension,
    )
    reader.feed(payload)
    return reader


def _next(reader: msgpack.Unpacker) -> Any:
    try:
        return reader.unpack()
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise ValueError(f"not msgpack: {type(error).__name__}: {error}") from None


def seal(sha256: bytes) -> bytes:
    """The frame that ends a segment; ``sha256`` is the hash of everything before it."""
    return frame(SEAL, sha256)


def payload(content: bytes) -> bytes | None:
    """The payload in the bytes of one frame; None if they are damaged."""
    if not _is_header(content, 0):
        return None
    found, checksum = content[HEADER_BYTES:], _HEADER.unpack_from(content)[2]
    return found if zlib.crc32(found) == checksum else None


@dataclass
class Scan:
    """The content of a segment file."""

    names: Names = field(default_factory=Names)
    frames: list[tuple[int, int]] = field(default_factory=list)
    """Offset and length of each trajectory's payload."""
    damaged: list[tuple[int, int]] = field(default_factory=list)
    """Start and end (exclusive) of each damaged range."""
    sealed: str = ""
    """The SHA-256 in the seal; empty for a segment without a seal."""
    size: int = 0

    @property
    def intact(self) -> list[tuple[int, int]]:
        """Start and end (exclusive) of each range between the damaged ones, without the seal."""
        cuts = [(0, 0), *self.damaged, (self.size - SEAL_BYTES if self.sealed else self.size, self.size)]
        spans = ((before[1], after[0]) for before, after in itertools.pairwise(cuts))
        return [span for span in spans if span[0] < span[1]]

    def without(self, frames: Sequence[tuple[int, int]]) -> Scan:
        """The same content, with these frames counted as damaged."""
        out = [(offset - HEADER_BYTES, offset + length) for offset, length in frames]
        return replace(self, damaged=sorted([*self.damaged, *out]))


def scan(path: Path) -> Scan:
    """Read and check a whole segment.

    Raises OtherFormat for a segment of another format, and ValueError for intact frames with invalid content.
    """
    found = Scan(size=path.stat().st_size)
    if not found.size:
        return found
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        offset = 0
        while offset < found.size:
            end, checksum = _end(data, offset)
            if checksum is None or end > found.size or zlib.crc32(data[offset + HEADER_BYTES : end]) != checksum:
                _add_damage(found, offset, min(end, found.size))
            else:
                _add_frame(data, offset, end, found)
            offset = end
    return found


def _add_damage(found: Scan, start: int, end: int) -> None:
    if found.damaged and found.damaged[-1][1] == start:
        start = found.damaged.pop()[0]
    found.damaged.append((start, end))


def _add_frame(data: mmap.mmap, offset: int, end: int, found: Scan) -> None:
    magic, start = data[offset : offset + 4], offset + HEADER_BYTES
    if found.sealed:
        raise ValueError(f"a frame after the seal at byte {offset}")
    if magic == NAME:
        found.names.read(data[start:end])
    elif magic == SEAL:
        if end - offset != SEAL_BYTES:
            raise ValueError(f"a seal of {end - offset} bytes at byte {offset}, expected {SEAL_BYTES}")
        found.sealed = data[start:end].hex()
    else:
        found.frames.append((start, end - start))


def _end(data: mmap.mmap, offset: int) -> tuple[int, int | None]:
    """The end of the frame at ``offset`` and its payload's checksum; without a frame there, the next frame's start and None."""
    if _is_header(data, offset):
        _, length, checksum, _ = _HEADER.unpack_from(data, offset)
        return offset + HEADER_BYTES + length, checksum
    following = data.find(_PREFIX, offset + 1)
    while following >= 0 and not _is_header(data, following):
        following = data.find(_PREFIX, following + 1)
    return (following if following >= 0 else len(data)), None


def _is_header(data: mmap.mmap | bytes, offset: int) -> bool:
    """Whether an intact header is there.  Raises OtherFormat if it is one of another format."""
    head = data[offset : offset + HEADER_BYTES]
    number, kind = head[2:3], head[3:4]
    if (
        len(head) < HEADER_BYTES
        or head[:2] != _PREFIX
        or not (number.isdigit() or number == _FIRST)
        or kind not in (b"N", b"T", b"S")
        or zlib.crc32(head[:12]) != _HEADER.unpack(head)[3]
    ):
        return False
    found = 1 if number == _FIRST else int(number)
    if found != FORMAT:
        raise OtherFormat(
            f"dataset format {found}, this release reads {FORMAT}: use the release that wrote it, or start a new run"
        )
    return True


def copy(source: Path, spans: Sequence[tuple[int, int]], target: BinaryIO, sealed: bool) -> None:
    """Write these ranges of a segment to ``target``, with a new seal if ``sealed``."""
    digest = hashlib.sha256()
    with source.open("rb") as file:
        for start, end in spans:
            file.seek(start)
            part = file.read(end - start)
            digest.update(part)
            target.write(part)
    if sealed:
        target.write(seal(digest.digest()))
