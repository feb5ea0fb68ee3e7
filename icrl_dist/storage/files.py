"""Files that are whole or not there, and checkpoints: arrays and a manifest, without pickle."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np


class StoreError(RuntimeError):
    """A run folder that cannot be used as asked: which file, what is wrong, the remedy."""


@dataclass(frozen=True)
class Checkpoint:
    """Arrays by name and a manifest of plain values."""

    arrays: Mapping[str, np.ndarray]
    manifest: Mapping[str, Any]

    def part(self, prefix: str) -> dict[str, np.ndarray]:
        """The arrays whose name begins with ``prefix/``, without it."""
        return {k.removeprefix(prefix + "/"): v for k, v in self.arrays.items() if k.startswith(prefix + "/")}


def hold(folder: Path, timeout_s: float = 10.0) -> IO[bytes]:
    """Be the only one at work in a run folder until the returned file is closed, or this process ends.

    The folder may be moved meanwhile, or replaced while this waits: the lock that counts is the one
    that is in the folder now.  Raises StoreError if somebody else still is at work after
    ``timeout_s``: a run that was just killed needs a moment to go.
    """
    path = folder / ".lock"
    deadline = time.monotonic() + timeout_s
    while True:
        file = path.open("ab")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except BlockingIOError:
            if time.monotonic() > deadline:
                file.close()
                raise StoreError(f"{folder}: another learner is at work in this folder; end it, or use another --out") from None
            time.sleep(0.05)
        file.close()


def held(folder: Path) -> bool:
    """Whether somebody is at work in a run folder, as far as this machine can tell; leaves it as it is."""
    try:
        with (folder / ".lock").open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: others who ask are not in the way
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def version_file(folder: Path, version: int) -> Path:
    """Where T^version lies."""
    return folder / "checkpoints" / f"version-{version:04d}.npz"


def newest_version(folder: Path) -> int:
    """The newest complete version in a run folder; -1 if there is none."""
    names = (folder / "checkpoints").glob("version-[0-9][0-9][0-9][0-9].npz")
    return max((int(name.stem.removeprefix("version-")) for name in names), default=-1)


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint so that ``path`` holds the old one or the new one, never half of one."""
    manifest = np.frombuffer(json.dumps(checkpoint.manifest).encode(), dtype=np.uint8)
    arrays: dict[str, Any] = {f"a/{name}": value for name, value in checkpoint.arrays.items()}
    atomic_write(path, lambda file: np.savez(file, manifest=manifest, **arrays))


def load_checkpoint(path: Path) -> Checkpoint:
    """Raises StoreError if the file is missing or is not a checkpoint; executes nothing in it."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            size, unpacked = path.stat().st_size, sum(member.file_size for member in file.zip.infolist())
            if unpacked > size:
                raise ValueError(f"{size} bytes that would unpack to {unpacked}")
            manifest = json.loads(file["manifest"].tobytes())
            arrays = {name.removeprefix("a/"): file[name] for name in file.files if name.startswith("a/")}
            if not isinstance(manifest, dict) or not all(isinstance(array, np.ndarray) for array in arrays.values()):
                raise ValueError("its manifest is no table, or one of its arrays is none")
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
        raise unwritten(path, error) from error
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a folder's new names durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unwritten(path: Path, error: OSError) -> StoreError:
    """What to say of a file that could not be written."""
    return StoreError(f"{path}: could not be written ({error.strerror}): free space, then use --resume")


def explained(error: Exception) -> Exception:
    """A full disk's error as one that says the remedy; any other as it is."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return unwritten(Path(error.filename or "a file of the run folder"), error)
    return error
