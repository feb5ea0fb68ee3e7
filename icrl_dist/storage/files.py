"""Atomic writes, and the lock of a run folder."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, BinaryIO


class StoreError(RuntimeError):
    """A run folder or a file of it cannot be used; the message says which, why, and the remedy."""


_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFBLK: "a device",
    stat.S_IFCHR: "a device",
}


def require_file(path: Path, follow: bool = True) -> None:
    """Raises StoreError unless ``path`` is a file, or with ``follow`` a link to one; FileNotFoundError if it does not exist.

    Opening a named pipe would wait for ever.
    """
    mode = path.stat().st_mode if follow else path.lstat().st_mode
    if not stat.S_ISREG(mode):
        raise StoreError(f"{path}: is {_KINDS.get(stat.S_IFMT(mode), 'no file')}, expected a file: move it away")


def require_plain(path: Path) -> None:
    """Raises StoreError if ``path`` exists and is not a file; a link, which can lead out of the run folder, is refused too."""
    with contextlib.suppress(FileNotFoundError):
        require_file(path, follow=False)


def hold(folder: Path, timeout_s: float = 10.0, name: str = ".lock") -> IO[bytes]:
    """Lock a run folder, by its file ``name``, until the returned file is closed or this process ends.

    Another process may move or replace the folder while this one waits, so the lock must be on
    the file that is in the folder afterwards.  Raises StoreError if another process still has the
    lock after ``timeout_s``; a process that was just killed needs a moment to end.  On a file system
    without locks the file is returned unlocked; see ``without_locks``.
    """
    path = folder / name
    require_plain(path)
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
                raise StoreError(f"{folder}: another learner uses this folder; end it, or use another --out") from None
            time.sleep(0.05)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return file
            file.close()
            raise
        file.close()


_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
"""Errors of ``flock`` on file systems that have no locks, such as Lustre or NFS without their lock service."""


def without_locks(folder: Path) -> str:
    """A warning if the file system of a run folder has no locks; empty if it has."""
    try:
        with (folder / ".lock").open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return (
                f"{folder}: its file system has no locks ({error.strerror}), so nothing prevents a second run there: start none"
            )
    return ""


def held(folder: Path, name: str = ".lock") -> bool:
    """Whether a process has locked a run folder by its file ``name``, as far as this node can see.  Changes nothing."""
    try:
        require_plain(folder / name)
        with (folder / name).open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # a shared lock, so simultaneous calls do not see each other
    except BlockingIOError:
        return True
    except (FileNotFoundError, PermissionError):
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    return False


def atomic_write(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Call ``write`` with a new file beside ``path``, make it durable, and rename it to ``path``.

    Raises StoreError if that is impossible; ``path`` then holds what it held before.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        sync_folder(path.parent)
    except OSError as error:
        raise unwritten(path, error) from error


def write_json(path: Path, value: object) -> None:
    """Write JSON values to ``path`` as ``atomic_write`` does, indented, with a newline at the end."""
    content = json.dumps(value, indent=1).encode() + b"\n"
    atomic_write(path, lambda file: file.write(content))


def sync_folder(folder: Path) -> None:
    """Make new and renamed files of a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unwritten(path: Path, error: OSError) -> StoreError:
    """The error for a file that could not be written, with the remedy."""
    remedy = _REMEDIES.get(error.errno or 0, "make it writable, or use another folder")
    return StoreError(f"{path}: could not be written ({error.strerror}): {remedy}")


RESUME = "use --resume"
"""The end of remedies for what a training could not write."""
_SPACE = f"free space, then {RESUME}"
_REMEDIES = {
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EROFS: f"this file system is read-only: use another folder, or mount it writable and {RESUME}",
    errno.EIO: f"its disk fails: copy the folder to another disk, then {RESUME} there",
    errno.EMFILE: f"raise the limit of open files, as in ulimit -n 65536, then {RESUME}",
    errno.ENFILE: f"this machine has too many open files: end other programs, then {RESUME}",
    errno.ENAMETOOLONG: "use a folder with a shorter name",
}
"""What to do about errors of the machine, by number.  They are no errors of this program, so no traceback is shown."""


def explained(error: Exception) -> Exception:
    """An error of the machine, such as a full disk, as a StoreError with the remedy; any other error unchanged."""
    if isinstance(error, OSError) and error.errno in _REMEDIES:
        return unwritten(Path(os.fsdecode(error.filename or "a file")), error)
    return error
