"""The rows of a run's metrics in the run folder: bounded files of JSON lines.

The newest rows are in ``metrics.jsonl``.  When this file is full it becomes ``metrics.jsonl.1``, which becomes
``metrics.jsonl.2``, and so on; the oldest file is removed.  Every reader uses ``read``.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from icrl_dist.storage.files import atomic_write

NAME = "metrics.jsonl"
MAX_BYTES = 16 << 20
"""Size of a full file."""
OLDER = 4
"""Number of full files that are kept."""

Row = dict[str, Any]


def read(folder: Path, last_bytes: int | None = None) -> Iterator[Row]:
    """The valid rows of a run folder, in the order in which they were written; none if there is no file.

    ``last_bytes``: read only so many bytes at the end.  A file that becomes another one during the call is read once.
    """
    seen, opened, left = set[int](), list[BinaryIO](), last_bytes
    with contextlib.ExitStack() as closing:
        for path in _files(folder):  # the newest first: a file that is renamed meanwhile is found again, and none is missed
            if not path.is_file():
                continue
            try:
                file: BinaryIO = closing.enter_context(path.open("rb"))
            except FileNotFoundError:
                continue
            status = os.fstat(file.fileno())
            if status.st_ino in seen:
                continue
            seen.add(status.st_ino)
            opened.append(file)
            if left is not None:
                if left < status.st_size:
                    file.seek(status.st_size - left)
                    file.readline()  # the rest of a line
                    break
                left -= status.st_size
        for file in reversed(opened):
            yield from filter(None, map(_parsed, file))


def _files(folder: Path) -> list[Path]:
    """The paths of all files, the newest first."""
    return [folder / NAME, *(folder / f"{NAME}.{number}" for number in range(1, OLDER + 1))]


def _parsed(line: bytes) -> Row | None:
    """The row of a line; None for a line that a kill or a full disk has left incomplete."""
    try:
        row = json.loads(line.decode(errors="replace"))
    except ValueError:
        return None
    valid = isinstance(row, dict) and isinstance(row.get("stage"), str)
    return row if valid and all(isinstance(row.get(name), int | float) for name in ("time", "step")) else None


class RowWriter:
    """Appends rows.  Its methods raise OSError if a file cannot be written."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / NAME
        self._end_last_line()
        self._open()

    def _open(self) -> None:
        self._file = self._path.open("ab", buffering=0)
        self._size = self._path.stat().st_size

    def _end_last_line(self) -> None:
        """Cut off a line that was written in part, so that the next row does not become a part of it."""
        if self._path.is_file():  # a device has no last line
            with self._path.open("rb+") as file:
                content = file.read()
                if not content.endswith(b"\n"):
                    file.truncate(content.rfind(b"\n") + 1)

    def append(self, row: Row) -> None:
        line = json.dumps(row).encode() + b"\n"
        if self._size and self._size + len(line) > MAX_BYTES:
            self._begin_next_file()
        if self._file.write(line) < len(line):
            self._file.truncate(self._size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._size += len(line)

    def _begin_next_file(self) -> None:
        self._file.close()
        newest_first = _files(self._folder)
        for path, older in reversed(list(itertools.pairwise(newest_first))):
            if path.exists():
                path.replace(older)
        self._open()

    def remove(self, superseded: Callable[[Row], bool]) -> None:
        """Remove the rows for which ``superseded`` is true, and lines that are no rows."""
        self._file.close()
        for path in _files(self._folder):
            if path.exists():
                lines = path.read_bytes().splitlines(keepends=True)
                kept = [line for line in lines if (row := _parsed(line)) and not superseded(row)]
                if len(kept) < len(lines):
                    atomic_write(path, lambda file, kept=kept: file.writelines(kept))  # type: ignore[misc]
        self._open()

    def close(self) -> None:
        self._file.close()
