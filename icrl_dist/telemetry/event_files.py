"""TensorBoard's event files: numbers that a resumed run writes again are removed from them.

``SummaryWriter(purge_step=...)`` cannot do this: a reader then drops the later steps of every name, also of
earlier fits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from icrl_dist.storage.files import atomic_write

_PATTERN = "events.out.tfevents.*"
_HEADER, _FOOTER = 12, 4
"""Bytes before and after the content of a record: its length with a checksum, and a checksum of the content."""


def remove(folder: Path, superseded: Callable[[str, int], bool]) -> None:
    """Remove the events for which ``superseded(name, step)`` is true from all event files of a folder.

    Raises OSError if a file cannot be written.
    """
    for path in sorted(folder.glob(_PATTERN)):
        content = path.read_bytes()
        records = list(_records(content))
        kept = [record for record in records if not _matches(record, superseded)]
        if len(kept) < len(records):
            atomic_write(path, lambda file, kept=kept: file.writelines(kept))  # type: ignore[misc]


def _records(content: bytes) -> Iterator[bytes]:
    """The complete records of a file."""
    at = 0
    while at + _HEADER <= len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        end = at + _HEADER + length + _FOOTER
        if end > len(content):
            return
        yield content[at:end]
        at = end


def _matches(record: bytes, superseded: Callable[[str, int], bool]) -> bool:
    return any(superseded(tag, step) for tag, step in _numbers(record))


def last_step(folder: Path, prefix: str) -> int:
    """The last step of all names that begin with ``prefix``; 0 without one."""
    files = folder.glob(_PATTERN)
    found = (pair for path in files for record in _records(path.read_bytes()) for pair in _numbers(record))
    return max((step for tag, step in found if tag.startswith(prefix)), default=0)


def _numbers(record: bytes) -> list[tuple[str, int]]:
    """Name and step of the numbers in a record."""
    from tensorboard.compat.proto.event_pb2 import Event  # slow to import

    try:
        event = Event.FromString(record[_HEADER:-_FOOTER])
    except Exception:  # a damaged record: TensorBoard reports it
        return []
    return [(value.tag, event.step) for value in event.summary.value]
