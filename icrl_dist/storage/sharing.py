"""Sharing the data of another run: hard links to its segments, checked against their hashes."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from icrl_dist.storage import segment
from icrl_dist.storage.dataset import segment_path, segments
from icrl_dist.storage.files import StoreError, atomic_write
from icrl_dist.types import Identity


def adopt(theirs: Path, folder: Path, keep: Callable[[Identity], bool]) -> int:
    """Share the trajectories of another dataset that ``keep`` accepts; returns the bytes of linked segments.

    A sealed segment of which all trajectories are kept is linked, if the file system can; of
    others the kept trajectories are copied.  Raises StoreError for a segment that is damaged or of
    another format.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shared = number = 0
    for source in segments(theirs).values():
        target, found = segment_path(folder, number), _checked(source)
        unwanted = _unwanted(source, found, keep)
        if len(unwanted) == len(found.frames):
            continue
        number += 1
        if found.sealed and not unwanted:
            _link(source, target)
            shared += found.size
        else:
            _write(target, source, found.without(unwanted))
    return shared


def _checked(path: Path) -> segment.Scan:
    remedy = "`icrl-dist train --resume` that run first, which repairs its dataset"
    try:
        found = segment.scan(path)
        content = path.read_bytes()[: max(0, found.size - segment.SEAL_BYTES)]
    except segment.OtherFormat as error:
        raise StoreError(f"{path}: {error}") from None
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: cannot be shared ({error}); {remedy}") from None
    if found.damaged or (found.sealed and hashlib.sha256(content).hexdigest() != found.sealed):
        raise StoreError(f"{path}: damaged, so it cannot be shared; {remedy}")
    return found


def _unwanted(path: Path, found: segment.Scan, keep: Callable[[Identity], bool]) -> list[tuple[int, int]]:
    unwanted = []
    with path.open("rb") as file:
        for offset, length in found.frames:
            file.seek(offset)
            if not keep(segment.decode(file.read(length), found.names).identity):
                unwanted.append((offset, length))
    return unwanted


def _write(target: Path, source: Path, found: segment.Scan) -> None:
    atomic_write(target, lambda file: segment.copy(source, found.intact, file, sealed=True))


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without hard links

        def copy(file: BinaryIO) -> None:
            with source.open("rb") as opened:
                shutil.copyfileobj(opened, file)

        atomic_write(target, copy)
