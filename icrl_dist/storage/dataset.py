"""A run's dataset: append-only segment files, repaired when they are opened, and an index of them.

Nothing is pickled, so opening the dataset of an untrusted run executes no code of it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from io import FileIO
from pathlib import Path
from typing import Any

from icrl_dist.copies import NotCopied
from icrl_dist.storage import segment
from icrl_dist.storage.files import StoreError, atomic_write, require_plain, sync_folder, unwritten
from icrl_dist.storage.index import Index, Row
from icrl_dist.stream.validation import VERSION
from icrl_dist.types import Identity, Trajectory

_NAME = re.compile(r"segment-(\d{6})\.frames")

Check = Callable[[Trajectory], str]
"""Why a stored trajectory cannot be used; empty if it can."""


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment of the dataset in this folder."""
    return folder / f"segment-{number:06d}.frames"


def segments(folder: Path) -> dict[int, Path]:
    """The segment files of a dataset's folder by number, in order.

    Raises StoreError, with the name, for a folder, a link or a pipe in place of a file, and for a segment whose name is
    not one that this program gives; FileNotFoundError is no error: a new run has no folder yet.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise StoreError(f"{folder}: is not a folder (a link or a file), expected the folder of the dataset: move it away")
    found: dict[int, Path] = {}
    for path in sorted(folder.glob("segment-*")):
        name = _NAME.fullmatch(path.name)
        if name is None:
            raise StoreError(f"{path}: no name of a segment; they are segment-000000.frames and so on: move it away")
        require_plain(path)
        found[int(name[1])] = path
    return found


class Damaged(StoreError):  # noqa: N818
    """Bytes changed after they were written; ``Dataset.repair`` removes them."""


class Dataset(NotCopied):
    """A run's dataset: one process appends to it, and trajectories are durable when ``append`` returns.

    Unless it is opened ``readonly``, damage by a crash or a disk is removed on opening.
    """

    instead = "it holds open files; open its folder a second time with readonly=True"

    def __init__(
        self,
        folder: Path,
        seal_bytes: int = 256 << 20,
        durable: bool = True,
        readonly: bool = False,
        check: Check = lambda trajectory: "",
    ) -> None:
        """``readonly`` changes nothing on disk; ``durable=False`` omits the fsync, to measure its cost.

        ``check`` is called with each stored trajectory; one that cannot be used is removed like damaged ones, or left out
        if ``readonly``.  Raises StoreError for files of another format, for odd files, and for files that cannot be written.
        """
        self.folder, self._seal_bytes, self._durable, self._readonly = folder, seal_bytes, durable, readonly
        self._check = check
        self._lock = threading.RLock()
        self._open()

    def _open(self) -> None:
        if not self._readonly:
            self.folder.mkdir(parents=True, exist_ok=True)
        self.damage: list[str] = []
        """What is damaged or missing, a line each; a dataset that is not ``readonly`` has removed it."""
        self.index = Index()
        self._names: dict[int, segment.Names] = {}
        self._sealed: dict[int, str] = {}
        self._readers: dict[int, int] = {}
        self._file: FileIO | None = None
        self._hash = hashlib.sha256()
        found = segments(self.folder)
        self._fill(found)
        for number, path in sorted(found.items()):
            self._load(path, number, last=number == max(found))
        self._count = max(self._names, default=-1) + 1
        last = self._path(self._count - 1)
        if not self._readonly and self._count and self._count - 1 not in self._sealed:
            self._file = last.open("ab", buffering=0)
            self._hash = hashlib.sha256(last.read_bytes())

    def _fill(self, found: dict[int, Path]) -> None:
        """Note the missing segments; unless ``readonly``, put empty ones in their places.

        Raises StoreError for a segment whose number is out of order: more are missing before it than are there.
        """
        missing = [number for number in range(max(found, default=-1)) if number not in found]
        if len(missing) > len(found):
            raise StoreError(
                f"{found[max(found)]}: out of order, {len(missing)} segments before it are missing: restore them, or move it "
                "away; `icrl-dist train --resume` then collects its data again"
            )
        for number in missing:
            path = self._path(number)
            self.damage.append(f"{path.name}: is missing")
            if not self._readonly:
                atomic_write(path, lambda file: file.write(segment.seal(hashlib.sha256().digest())))
                found[number] = path

    def _load(self, path: Path, number: int, last: bool) -> None:
        """Check a segment, remove damage, and add its trajectories to the index."""
        done = "" if self._readonly else "removed "
        try:
            found = segment.scan(path)
            cut = not last and not found.sealed
            if cut and not found.damaged:
                self.damage.append(f"{path.name}: its end is missing after byte {found.size}")
            for start, end in found.damaged:
                torn = last and not found.sealed and [found.damaged[-1][1]] == [found.size] and len(found.damaged) == 1
                what = ("a torn tail of" if torn else "a damaged range of") + f" {end - start} bytes at byte {start}"
                self.damage.append(f"{path.name}: {'cut off ' if torn and done else done}{what}")
            if (found.damaged or cut) and not self._readonly:
                found = self._remove_damage(path, found, sealed=not last)
            unusable = self._add(path, number, found)
            if unusable and not self._readonly:
                found = self._remove_damage(path, found.without(unusable), sealed=not last)
        except segment.OtherFormat as error:
            raise StoreError(f"{path}: {error}") from None
        except (ValueError, OSError) as error:
            raise StoreError(
                f"{path}: not a dataset of this version of icrl-dist, format {VERSION} ({error}): restore the file, or start a "
                "new run with another --out; `icrl-dist evaluate` and `export` of the old run do not need it"
            ) from None
        self._names[number] = found.names
        if found.sealed:
            self._sealed[number] = found.sealed

    def _remove_damage(self, path: Path, found: segment.Scan, sealed: bool) -> segment.Scan:
        atomic_write(path, lambda file: segment.copy(path, found.intact, file, sealed))
        return segment.scan(path)

    def _add(self, path: Path, number: int, found: segment.Scan) -> list[tuple[int, int]]:
        """Add a segment's trajectories to the index; returns the frames that cannot be used."""
        unnamed: list[tuple[int, int]] = []
        refused: list[tuple[int, int]] = []
        done = "" if self._readonly else "removed "

        def rows() -> Iterator[Row]:
            with path.open("rb") as file:
                for offset, length in found.frames:
                    file.seek(offset)
                    try:
                        trajectory = segment.decode(file.read(length), found.names)
                    except segment.MissingName:
                        unnamed.append((offset, length))
                        continue
                    if reason := self._check(trajectory):
                        refused.append((offset, length))
                        self.damage.append(f"{path.name}: {done}a trajectory at byte {offset}, {reason}")
                    else:
                        yield Row.of(trajectory, number, offset, length)

        before = len(self.index)
        self.index.add(rows())
        if found.frames and len(self.index) == before and not unnamed and not refused:
            raise StoreError(f"{path}: holds only trajectories that other segments hold: it is a copy of one, move it away")
        if unnamed:
            self.damage.append(f"{path.name}: {done}{len(unnamed)} trajectories whose names were damaged")
        return unnamed + refused

    def append(self, trajectories: Sequence[Trajectory]) -> None:
        """Append trajectories; all of them are durable on return (one fsync).

        The learner acknowledges a trajectory to its sender only afterwards.  Raises StoreError if
        they cannot be written; then none of them is kept.
        """
        if not trajectories:
            return
        with self._lock:
            if self._file is None or self._file.tell() >= self._seal_bytes:
                self.seal()
                self._begin()
            assert self._file is not None
            number = self._count - 1
            start = at = self._file.tell()
            parts: list[bytes] = []
            rows: list[Row] = []
            for trajectory in trajectories:
                new_names, frame = segment.encode(trajectory, self._names[number])
                parts += [new_names, frame]
                at += len(new_names) + len(frame)
                length = len(frame) - segment.HEADER_BYTES
                rows.append(Row.of(trajectory, number, at - length, length))
            self._write(b"".join(parts), start)
            self.index.add(rows)

    def seal(self) -> None:
        """End the current segment with its SHA-256; it never changes afterwards."""
        with self._lock:
            if self._file is None:
                return
            sha256 = self._hash.digest()
            self._write(segment.seal(sha256), self._file.tell())
            self._sealed[self._count - 1] = sha256.hex()
            self._file.close()
            self._file = None

    def _write(self, content: bytes, start: int) -> None:
        assert self._file is not None
        try:
            left = memoryview(content)
            while left:
                left = left[self._file.write(left) :]
            if self._durable:
                os.fsync(self._file.fileno())
        except OSError as error:
            path = self._path(self._count - 1)
            with contextlib.suppress(OSError):
                self._file.truncate(start)
                self._names[self._count - 1] = segment.scan(path).names
            raise unwritten(path, error) from error
        self._hash.update(content)

    def _begin(self) -> None:
        path = self._path(self._count)
        try:
            self._file = path.open("ab", buffering=0)
            sync_folder(self.folder)
        except OSError as error:
            raise unwritten(path, error) from error
        self._names[self._count], self._hash = segment.Names(), hashlib.sha256()
        self._count += 1

    def repair(self) -> list[str]:
        """Check every byte again and remove damage; returns what was removed."""
        with self._lock:
            self.close()
            self._open()
            return self.damage

    def close(self) -> None:
        with self._lock:
            if self._file is not None:
                self._file.close()
                self._file = None
            while self._readers:
                os.close(self._readers.popitem()[1])
            self.index.close()

    def __contains__(self, identity: Identity) -> bool:
        with self._lock:
            return identity in self.index

    def __len__(self) -> int:
        return len(self.index)

    def read(self, identity: Identity) -> Trajectory:
        """The trajectory of this identity.  Raises KeyError if there is none, Damaged if its bytes changed."""
        return self._read(self.index[identity])

    def variations(self, stage: str, round: int) -> list[tuple[str, int, int, int]]:
        """The stored variations of one stage and round, in canonical order: (stage, round, task, variation)."""
        return self.index.variations(stage, round)

    def trials(self, key: tuple[str, int, int, int]) -> list[Trajectory]:
        """The trajectories of one variation, in order of trial.  Raises Damaged if the bytes of one changed."""
        return [self._read(row) for row in self.index.trials(key)]

    def _read(self, row: Row) -> Trajectory:
        if row.segment not in self._readers:
            self._readers[row.segment] = os.open(self._path(row.segment), os.O_RDONLY)
        content = os.pread(self._readers[row.segment], segment.HEADER_BYTES + row.length, row.offset - segment.HEADER_BYTES)
        payload = segment.payload(content)
        if payload is None:
            path = self._path(row.segment)
            raise Damaged(f"{path}: damaged at byte {row.offset}, in {row.identity}; --resume removes and collects it again")
        return segment.decode(payload, self._names[row.segment])

    def digest(self, version: int | None = None) -> str:
        """SHA-256 over every array and label byte, in canonical order.

        With ``version``, only over the data that T^version was fitted to.  It does not depend on
        the number of workers or on crashes.
        """
        total = hashlib.sha256()
        for sha256 in self.index.digests(version):
            total.update(sha256.encode())
        return total.hexdigest()

    def manifest(self) -> list[dict[str, Any]]:
        """The sealed segments: ``segment`` (file name), ``bytes``, and ``sha256`` of everything before the seal."""
        return [
            {"segment": path.name, "bytes": path.stat().st_size, "sha256": self._sealed[number]}
            for number in sorted(self._sealed)
            for path in (self._path(number),)
        ]

    def _path(self, number: int) -> Path:
        return segment_path(self.folder, number)
