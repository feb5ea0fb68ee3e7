"""What a run leaves on disk: append-only trajectory segments and atomic checkpoints.

A segment is a row of frames ``length, checksum, payload``, where a payload is the wire's own
encoding of a trajectory.  The index is derived from the segments each time they are opened.
Nothing here is pickled, so opening a stranger's run executes none of their code.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from icrl_dist.stream import wire
from icrl_dist.types import Identity, Trajectory

_HEADER = struct.Struct("<II")
_PATTERN = "segment-*.frames"


class StoreError(RuntimeError):
    """A run folder that cannot be used as asked: which file, what is wrong, the remedy."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Where a trajectory lies, and the digest of what it holds."""

    segment: Path
    offset: int
    length: int
    digest: str


class Store:
    """A run's dataset: appended to by one process, durable when ``append`` returns."""

    def __init__(self, folder: Path, seal_bytes: int = 256 << 20, limit: int = 64 << 20) -> None:
        """Opens ``folder``, reads its index, and cuts off a tail that a crash tore.

        ``repaired`` names what was cut.  Raises StoreError if a frame before the tail is
        damaged.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self._seal_bytes, self._limit = folder, seal_bytes, limit
        self.index: dict[Identity, Entry] = {}
        self.repaired: list[str] = []
        segments = sorted(folder.glob(_PATTERN))
        for segment in segments:
            self._scan(segment, last=segment == segments[-1])
        self._count = len(segments)
        self._file: BinaryIO | None = segments[-1].open("ab") if segments else None

    def __contains__(self, identity: Identity) -> bool:
        return identity in self.index

    def __len__(self) -> int:
        return len(self.index)

    def append(self, items: Sequence[tuple[Trajectory, bytes]]) -> None:
        """Append trajectories with their wire bytes; all are durable on return (one fsync).

        Whoever acknowledges a trajectory to its sender calls this first.
        """
        if not items:
            return
        if self._file is None or self._file.tell() >= self._seal_bytes:
            self._roll()
        assert self._file is not None
        offset = self._file.tell()
        entries: dict[Identity, Entry] = {}
        frames = io.BytesIO()
        segment = Path(self._file.name)
        for trajectory, payload in items:
            frames.write(_HEADER.pack(len(payload), zlib.crc32(payload)))
            at = offset + frames.tell()
            entries[trajectory.identity] = Entry(segment, at, len(payload), wire.trajectory_digest(trajectory))
            frames.write(payload)
        try:
            self._file.write(frames.getbuffer())
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(offset)
            raise StoreError(f"{segment}: could not be written ({error.strerror}): free space, then use --resume") from error
        self.index.update(entries)

    def read(self, identity: Identity) -> Trajectory:
        """The trajectory of this identity.  Raises KeyError if there is none."""
        entry = self.index[identity]
        with entry.segment.open("rb") as file:
            file.seek(entry.offset)
            return wire.decode_trajectory(file.read(entry.length), self._limit)

    def select(self, stage: str, round: int) -> Iterator[Trajectory]:
        """The trajectories of one stage and round in canonical order, whatever order they came in."""
        chosen = sorted((i for i in self.index if i.stage == stage and i.round == round), key=Identity.key)
        files: dict[Path, BinaryIO] = {}
        with contextlib.ExitStack() as stack:
            for identity in chosen:
                entry = self.index[identity]
                file = files.get(entry.segment) or files.setdefault(
                    entry.segment, stack.enter_context(entry.segment.open("rb"))
                )
                file.seek(entry.offset)
                yield wire.decode_trajectory(file.read(entry.length), self._limit)

    def digest(self) -> str:
        """One digest of the whole dataset: every array and label byte, in canonical order.

        Equal for any number of workers, whatever died on the way.
        """
        total = hashlib.sha256()
        for identity in sorted(self.index, key=Identity.key):
            total.update(self.index[identity].digest.encode())
        return total.hexdigest()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _roll(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = (self.folder / f"segment-{self._count:06d}.frames").open("ab")
        self._count += 1
        _sync_folder(self.folder)

    def _scan(self, segment: Path, last: bool) -> None:
        size, offset = segment.stat().st_size, 0
        with segment.open("rb") as file:
            while offset < size:
                head = file.read(_HEADER.size)
                length, checksum = _HEADER.unpack(head) if len(head) == _HEADER.size else (0, None)
                payload = file.read(length)
                end = offset + _HEADER.size + length
                if checksum is None or len(payload) < length or zlib.crc32(payload) != checksum:
                    if last and (checksum is None or end >= size):
                        self.repaired.append(f"{segment.name}: cut a torn tail of {size - offset} bytes at {offset}")
                        os.truncate(segment, offset)
                        return
                    raise StoreError(f"{segment}: damaged at byte {offset}; restore the file, or start the run anew")
                trajectory = wire.decode_trajectory(payload, self._limit)
                digest = wire.trajectory_digest(trajectory)
                self.index[trajectory.identity] = Entry(segment, offset + _HEADER.size, length, digest)
                offset = end


@dataclass(frozen=True)
class Checkpoint:
    """Arrays by name and a manifest of plain values."""

    arrays: Mapping[str, np.ndarray]
    manifest: Mapping[str, Any]

    def part(self, prefix: str) -> dict[str, np.ndarray]:
        """The arrays whose name begins with ``prefix/``, without it."""
        return {k.removeprefix(prefix + "/"): v for k, v in self.arrays.items() if k.startswith(prefix + "/")}


def version_file(folder: Path, version: int) -> Path:
    """Where T^version lies."""
    return folder / "checkpoints" / f"version-{version:04d}.npz"


def newest_version(folder: Path) -> int:
    """The newest complete version in a run folder; -1 if there is none."""
    names = (folder / "checkpoints").glob("version-*.npz")
    return max((int(name.stem.removeprefix("version-")) for name in names), default=-1)


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint so that ``path`` holds the old one or the new one, never half of one."""
    manifest = np.frombuffer(json.dumps(checkpoint.manifest).encode(), dtype=np.uint8)
    arrays: dict[str, Any] = {f"a/{name}": value for name, value in checkpoint.arrays.items()}
    atomic_write(path, lambda file: np.savez(file, manifest=manifest, **arrays))


def load_checkpoint(path: Path) -> Checkpoint:
    """Raises StoreError if the file is missing or is not a checkpoint; executes nothing in it."""
    try:
        with np.load(path, allow_pickle=False) as file:
            manifest = json.loads(file["manifest"].tobytes())
            arrays = {name.removeprefix("a/"): file[name] for name in file.files if name.startswith("a/")}
    except FileNotFoundError:
        raise StoreError(f"{path}: no such checkpoint") from None
    except Exception as error:
        raise StoreError(f"{path}: not a checkpoint of this system ({error})") from None
    return Checkpoint(arrays, manifest)


def atomic_write(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Call ``write`` on a new file beside ``path``, make it durable, and put it in its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise StoreError(f"{path}: could not be written ({error.strerror}): free space, then use --resume") from error
    finally:
        part.unlink(missing_ok=True)
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
