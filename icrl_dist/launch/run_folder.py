"""Run folders: the files that a run writes, the allowed places, and the replacement of one run by another.

User files are never deleted.  Only files that this program writes are removed; the list of their
names is in ``storage/layout.py``.  A folder with any other file is refused, and the message names the file.
A replaced run is kept beside its folder as ``.NAME.replaced`` until the new run has its first
checkpoint, and is restored if the new run ends before that.  Both folders hold the same random token
meanwhile, so that after a kill no other folder is mistaken for one of the two.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import threading
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from icrl_dist.config.run import ConfigError
from icrl_dist.console.display import ReportEvent
from icrl_dist.storage.checkpoint import newest_version
from icrl_dist.storage.files import StoreError, held, hold
from icrl_dist.storage.layout import NAMES, owned

WAIT_S = 10.0
"""Seconds to wait for the processes of a killed run to end before its folder counts as in use."""

LONGEST_NAME, LONGEST_PATH = 240, 4095 - 300
"""Bytes of a run folder's name and path.  File systems allow 255 and 4,095; ``.NAME.replaced`` and reports are longer."""

_TOKEN = ".replacement"
"""In a replaced run and in the run that replaces it: a random text that only these two folders hold."""
_BEGINNING = ".beginning"
"""In a folder that was empty and whose run has not begun: all files there are first files of that run, and none is lost."""


@contextlib.contextmanager
def beginning(folder: Path) -> Iterator[None]:
    """The first files of a run are written into an empty folder within this context.

    After a kill in between, ``recover`` removes them, so that the same command can be repeated.  Raises ConfigError if
    another command begins a run there at the same time, OSError if the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(folder, 0.0, _BEGINNING)
    except StoreError:
        raise ConfigError(f"--out {folder}: another command begins a run in this folder; use another --out") from None
    with lock:
        yield
        (folder / _BEGINNING).unlink(missing_ok=True)


def _sweep_beginning(folder: Path) -> None:
    """Remove the files of a run that was killed before it began."""
    if folder.is_symlink() or not (folder / _BEGINNING).is_file():
        return
    if held(folder, _BEGINNING):
        raise ConfigError(f"--out {folder}: another command begins a run in this folder; use another --out")
    token = _token(folder)
    remove(folder)
    if token:  # the old run is restored only where ``recover`` finds the token
        folder.mkdir()
        (folder / _TOKEN).write_bytes(token)


def foreign(folder: Path) -> list[str]:
    """Files in a run folder that this program does not write, as relative paths.  Links are not followed.

    Raises ConfigError for a folder that cannot be read.
    """
    try:
        return sorted(_foreign(folder, ""))
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be read ({error.strerror}); use another --out") from None


def _foreign(folder: Path, place: str) -> Iterator[str]:
    with os.scandir(folder / place) as entries:
        for entry in entries:
            path = f"{place}/{entry.name}" if place else entry.name
            if entry.is_dir(follow_symlinks=False):
                if path in NAMES:
                    yield from _foreign(folder, path)
                else:
                    yield f"{path}/"
            elif not (entry.is_file(follow_symlinks=False) and owned(place, entry.name)):
                yield path


def remove(folder: Path) -> None:
    """Remove a run folder if it exists and contains only files of this program.

    ``run.toml`` is removed first, so that a half removed folder does not count as a run, and the
    token of a replacement last, so that an interrupted removal can be finished.  Raises ConfigError,
    and removes nothing, if the folder is a link or contains other files.
    """
    if not os.path.lexists(folder):
        return
    if folder.is_symlink():
        raise ConfigError(f"{folder}: is a symbolic link, which is never removed; remove it yourself, or use another --out")
    require_owned(folder)
    (folder / "run.toml").unlink(missing_ok=True)
    for place in NAMES:
        directory = folder / place
        if directory.is_dir():
            with os.scandir(directory) as entries:
                names = [entry.name for entry in entries if entry.is_file(follow_symlinks=False) and owned(place, entry.name)]
            for name in sorted(names, key=lambda name: (name == _TOKEN, name == _BEGINNING)):
                (directory / name).unlink(missing_ok=True)
            directory.rmdir()  # fails if another file has appeared meanwhile


def unused(folder: Path) -> bool:
    """Whether a folder is empty, or holds only what a killed start of a run leaves: a lock, and parts of files."""
    return all(path.name == ".lock" or (path.suffix == ".part" and owned("", path.name)) for path in folder.iterdir())


def require_owned(folder: Path) -> None:
    """Raise ConfigError with their names if a folder contains files that this program does not write."""
    if others := foreign(folder):
        names = ", ".join(others[:5]) + (f" and {len(others) - 5} more" if len(others) > 5 else "")
        raise ConfigError(f"{folder}: holds {names}, not written by icrl-dist: move that away, or use another --out")


def check_place(folder: Path, source: Path | None = None) -> None:
    """Raise ConfigError if the folder cannot be a run folder.

    Refused are links, files, the current folder, the home folder and their parents, and any overlap
    with ``source``, the run of a fork.
    """
    remedy = "name a folder for this run only, such as runs/demo"
    try:
        real, current = folder.resolve(), Path.cwd().resolve()
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"--out {folder}: {error}; {remedy}") from None
    if len(os.fsencode(real)) > LONGEST_PATH or len(os.fsencode(real.name)) > LONGEST_NAME:
        limits = (
            f"a folder's name may have {LONGEST_NAME} bytes and its path {LONGEST_PATH}, because longer names are made in it"
        )
        raise ConfigError(f"--out {real.name[:40]}...: too long ({len(os.fsencode(real))} bytes); {limits}")
    if folder.is_symlink():
        raise ConfigError(f"--out {folder}: is a symbolic link; name the folder itself, {real}")
    if folder.name == "..":
        raise ConfigError(f"--out {folder}: ends in ..; name the folder itself, {real}")
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--out {folder}: is a file; {remedy}")
    if _contains(real, current):
        raise ConfigError(f"--out {folder}: is or contains the current folder (an empty --out means that folder); {remedy}")
    with contextlib.suppress(RuntimeError):  # no home folder
        if _contains(real, Path.home().resolve()):
            raise ConfigError(f"--out {folder}: is or contains the home folder; {remedy}")
    if source is not None:
        parent = source.resolve()
        if _contains(real, parent) or _contains(parent, real):
            raise ConfigError(f"--out {folder}: overlaps with {source}, the run of --from; use another --out")


def _contains(folder: Path, other: Path) -> bool:
    return folder == other or folder in other.parents


def aside_of(folder: Path) -> Path:
    """Where the old run of a folder is kept while a new run replaces it."""
    return folder.with_name(f".{folder.name}.replaced")


def recover(folder: Path) -> None:
    """Finish a beginning of a run in ``folder``, or a replacement of it, that was interrupted by a kill.

    A run that had not begun is removed; its folder was empty before.

    If the run in ``folder`` replaced the old one and has a checkpoint, the old run is removed.  If
    ``folder`` does not exist or holds nothing of a run, the old run is restored.  In every other case nothing is
    changed and ConfigError is raised; also while the command that replaces the run is still active.
    """
    _sweep_beginning(folder)
    aside = aside_of(folder)
    if not os.path.lexists(aside):
        return
    if held(aside) or held(folder):
        raise ConfigError(f"--out {folder}: a run is active in this folder; end it, or use another --out")
    token, removing = _token(aside), not (aside / "run.toml").exists()
    if not token and not (removing and _is_empty(aside)):
        raise ConfigError(f"{aside}: is not a run that --overwrite replaced; move it away, then repeat the command")
    if removing or (token == _token(folder) and _has_checkpoint(folder)):
        remove(aside)
    elif not os.path.lexists(folder) or _is_empty(folder) or _has_only(folder, token):
        remove(folder)
        aside.rename(folder)
        (folder / _TOKEN).unlink()
    else:
        raise ConfigError(
            f"{folder}: a command that was replacing this run was killed; the old run is in {aside}: "
            f"delete {folder} to restore the old run, or {aside} to keep the new run, then repeat the command"
        )


def _token(folder: Path) -> bytes:
    """The token of the replacement that the run in a folder belongs to; empty if it belongs to none."""
    path = folder / _TOKEN
    return b"" if folder.is_symlink() or path.is_symlink() or not path.is_file() else path.read_bytes()


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())


def _has_only(folder: Path, token: bytes) -> bool:
    """Whether a folder holds nothing but this token and a lock."""
    return _token(folder) == token and {path.name for path in folder.iterdir()} <= {_TOKEN, ".lock"}


def _has_checkpoint(folder: Path) -> bool:
    """Whether the run in a folder has a checkpoint of its own, beyond those of its fork, or has ended.

    The run in a folder without ``run.toml`` or with ``.beginning`` has not begun.  If ``fork.json`` is damaged, nobody knows
    whose the checkpoints are, and the answer is no, so that no run is removed.
    """
    if not (folder / "run.toml").is_file() or (folder / _BEGINNING).exists():
        return False
    first, record = -1, folder / "fork.json"
    if record.exists():
        try:
            first = int(json.loads(record.read_text())["version"])
        except (OSError, ValueError, KeyError, TypeError):
            return False
    return newest_version(folder) > first or (folder / "result.json").exists()


def take(folder: Path) -> IO[bytes]:
    """Lock a run folder until the returned file is closed.

    Raises ConfigError if a run is active in the folder, or if the folder cannot be written.
    """
    try:
        return hold(folder, WAIT_S)
    except StoreError:
        raise ConfigError(f"--out {folder}: a run is active in this folder; end it, or use another --out") from None
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None


class FolderTransaction:
    """Replaces the run in a folder by a new one, or restores it; a context around the new run.

    After ``set_aside`` the old run is removed when the new run has its first checkpoint, or when the
    context ends without an error.  The old run is restored if the context ends with an error, or is
    interrupted, before that.  Without ``set_aside`` nothing is removed or restored.
    """

    def __init__(self, folder: Path, start_version: int = -1) -> None:
        """``start_version``: the version that a fork starts from and did not produce; -1 for other runs."""
        self.rolled_back = False
        """Whether the old run is in its folder again."""
        self._folder, self._start_version = folder, start_version
        self._report: ReportEvent = lambda event: None
        self._lock: IO[bytes] | None = None
        self._deciding = threading.Lock()

    def set_aside(self) -> None:
        """Move the old run to ``aside_of(folder)``, keep it locked, and make an empty folder for the new run.

        Both folders get the token of this replacement.  Raises ConfigError, and changes nothing, if the
        folder contains no run or other files, or if a run is active in it.
        """
        folder = self._folder
        require_owned(folder)
        if not all((folder / name).is_file() for name in ("run.toml", "env.json")):
            raise ConfigError(f"--overwrite: {folder} holds no run; empty it, or use another --out")
        lock = take(folder)
        token = secrets.token_hex()
        try:
            (folder / _TOKEN).write_text(token)
            folder.rename(aside_of(folder))
        except OSError as error:
            lock.close()
            raise ConfigError(f"--overwrite: {folder} cannot be moved aside ({error.strerror}); use another --out") from None
        self._lock = lock
        try:
            folder.mkdir()
            (folder / _TOKEN).write_text(token)
        except OSError as error:
            self.roll_back()
            raise ConfigError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None

    def commit_at_checkpoint(self, report: ReportEvent) -> ReportEvent:
        """Wrap ``report`` so that the event of the new run's first checkpoint also removes the old run."""
        self._report = report

        def report_and_commit(event: dict[str, Any]) -> None:
            report(event)
            if event.get("version", -1) > self._start_version and newest_version(self._folder) > self._start_version:
                self.commit()

        return report_and_commit

    def commit(self) -> None:
        """Remove the old run.  If that fails, a note names its folder; that is no error."""
        with self._deciding:
            lock, self._lock = self._lock, None
        if lock is None:
            return
        with lock:
            try:
                remove(aside_of(self._folder))
                (self._folder / _TOKEN).unlink(missing_ok=True)
            except (OSError, ConfigError) as error:
                self._note(f"the replaced run could not be removed from {aside_of(self._folder)}: {error}")

    def roll_back(self) -> None:
        """Remove the new run and restore the old one.  If the folder contains user files, a note names both folders."""
        with self._deciding:
            lock, self._lock = self._lock, None
        if lock is None:
            return
        with lock:
            try:
                remove(self._folder)
                aside_of(self._folder).rename(self._folder)
                (self._folder / _TOKEN).unlink(missing_ok=True)
            except (OSError, ConfigError) as error:
                self._note(f"the old run of {self._folder} is kept in {aside_of(self._folder)}: {error}")
            else:
                self.rolled_back = True
                self._note(f"the old run is restored in {self._folder}")

    def _note(self, text: str) -> None:
        self._report({"event": "note", "text": text})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None or newest_version(self._folder) > self._start_version:
            self.commit()
        else:
            self.roll_back()
