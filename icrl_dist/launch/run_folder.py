"""Run folders: which files in one are this program's, where one may be, and how a run takes another's place.

Nothing of the user's is ever deleted.  Only files that this program wrote are removed, by a list of
their names that is kept here and nowhere else.  A folder with any other file is refused by the names
of those files.  A run that is replaced lies beside its folder as ``.NAME.replaced`` until the new
run has its first checkpoint, and comes back if the new run ends before that.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from icrl_dist.config.run import ConfigError
from icrl_dist.storage.checkpoint import newest_version
from icrl_dist.storage.files import StoreError, held, hold

Report = Callable[[dict[str, Any]], None]

WAIT_S = 10.0
"""A run that was just killed has so long to end before its folder counts as in use."""

_REPORTS = r"(online|posterior)-(.+-)?T\d+-[0-9a-f]*-.+\.(json|png)|(online|posterior)\.json|(adaptation|posterior)\.png"
_NAMES = {
    "checkpoints/report": _REPORTS,
    "checkpoints": r"version-\d+\.npz|partial\.npz|agent\.npz",
    "crashes": r".+-\d+\.json|.+\.stacks",
    "dataset": r"segment-\d+\.frames",
    "report": _REPORTS,
    "tensorboard": r"events\.out\.tfevents\..+",
    "": r"(run\.toml|env\.json|fork\.json|result\.json|metrics\.jsonl|agent\.npz|learner\.log|learner\.err|endpoint|\.lock)",
}
"""Every folder within a run folder, the deepest first, and a pattern of the names that this program writes there."""


def owned(place: str, name: str) -> bool:
    """Whether this program writes a file of this name into ``place``, a folder within a run folder ("" for the run folder).

    The parts that ``files.atomic_write`` leaves behind when it is killed count too.
    """
    pattern = _NAMES[place]
    return re.fullmatch(rf"(?s:{pattern}|\.({pattern})\.\d+\.part)", name) is not None


def foreign(folder: Path) -> list[str]:
    """What lies in a folder and is not this program's, by its path from there; links are never followed.

    Raises ConfigError for a folder that cannot be read.
    """
    try:
        return sorted(_foreign(folder, ""))
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be read ({error.strerror}); use another --out") from None


def _foreign(folder: Path, place: str) -> Iterator[str]:
    with os.scandir(folder / place) as entries:
        for entry in entries:
            within = f"{place}/{entry.name}" if place else entry.name
            if entry.is_dir(follow_symlinks=False):
                if within in _NAMES:
                    yield from _foreign(folder, within)
                else:
                    yield f"{within}/"
            elif not (entry.is_file(follow_symlinks=False) and owned(place, entry.name)):
                yield within


def remove(folder: Path) -> None:
    """Remove a run folder that holds nothing but this program's files; one that is not there is no error.

    ``run.toml`` goes first: a folder that was left half removed holds no run.  Raises ConfigError,
    and removes nothing, if the folder is a link or holds other files.
    """
    if not os.path.lexists(folder):
        return
    if folder.is_symlink():
        raise ConfigError(f"{folder}: is a link, and is not removed; remove it, or use another --out")
    _only_ours(folder)
    (folder / "run.toml").unlink(missing_ok=True)
    for place in _NAMES:
        here = folder / place
        if here.is_dir():
            with os.scandir(here) as entries:
                names = [entry.name for entry in entries if entry.is_file(follow_symlinks=False) and owned(place, entry.name)]
            for name in names:
                (here / name).unlink(missing_ok=True)
            here.rmdir()  # fails if a file has come that is not ours


def _only_ours(folder: Path) -> None:
    if others := foreign(folder):
        named = ", ".join(others[:5]) + (f" and {len(others) - 5} more" if len(others) > 5 else "")
        raise ConfigError(f"{folder}: holds {named}, not written by icrl-dist: move that away, or use another --out")


def check_place(folder: Path, source: Path | None = None) -> None:
    """Refuse a folder that is not, or cannot become, a run's own; ``source`` is the run that a fork begins with.

    Raises ConfigError.
    """
    remedy = "name a folder of the run's own, such as runs/demo"
    try:
        real, here = folder.resolve(), Path.cwd().resolve()
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"--out {folder}: {error}; {remedy}") from None
    if folder.is_symlink():
        raise ConfigError(f"--out {folder}: is a link; name the folder itself, {real}")
    if folder.name == "..":
        raise ConfigError(f"--out {folder}: ends in ..; name the folder itself, {real}")
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--out {folder}: is a file; {remedy}")
    if _holds(real, here):
        raise ConfigError(f"--out {folder}: is the current folder, as an empty --out also is, or holds it; {remedy}")
    with contextlib.suppress(RuntimeError):  # no home folder
        if _holds(real, Path.home().resolve()):
            raise ConfigError(f"--out {folder}: is the home folder, or holds it; {remedy}")
    if source is not None:
        parent = source.resolve()
        if _holds(real, parent) or _holds(parent, real):
            raise ConfigError(f"--out {folder}: is, holds or lies in {source}, the run of --from; use another --out")


def _holds(folder: Path, other: Path) -> bool:
    return folder == other or folder in other.parents


def aside_of(folder: Path) -> Path:
    """Where the run that was in a folder lies while another replaces it."""
    return folder.with_name(f".{folder.name}.replaced")


def recover(folder: Path) -> None:
    """Put right what a command that was killed while it replaced the run in ``folder`` has left.

    If the new run has a checkpoint, the old one is removed.  If the folder is gone, the old one
    takes its place again.  If both are there, neither is touched.  Raises ConfigError in the last
    case, and while such a command is still at work.
    """
    aside = aside_of(folder)
    if not os.path.lexists(aside):
        return
    if held(aside) or held(folder):
        raise ConfigError(f"--out {folder}: a run is on in this folder; end it, or use another --out")
    if not (aside / "run.toml").is_file() or _has_come_far(folder):
        remove(aside)
    elif not os.path.lexists(folder):
        aside.rename(folder)
    else:
        raise ConfigError(
            f"{folder}: a command that replaced the run in it was killed; the earlier run lies in {aside}: "
            f"delete {folder} to have that one back, or {aside} to keep the new one, then give the command again"
        )


def _has_come_far(folder: Path) -> bool:
    """Whether the run in a folder has made a checkpoint of its own, or ended."""
    first = -1
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        first = int(json.loads((folder / "fork.json").read_text())["version"])
    return newest_version(folder) > first or (folder / "result.json").exists()


def take(folder: Path) -> IO[bytes]:
    """Be the only one at work in a run folder until the returned file is closed.

    Raises ConfigError while a run is on in it.
    """
    try:
        return hold(folder, WAIT_S)
    except StoreError:
        raise ConfigError(f"--out {folder}: a run is on in this folder; end it, or use another --out") from None
    except OSError as error:
        raise ConfigError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None


class Begun:
    """A run that begins in a folder, as a context; ``set_aside`` makes it the successor of the one that is there.

    The earlier run is removed once the new one has its first checkpoint, or the context ends well.
    It comes back if the context ends with an error, or an interruption, before that.
    """

    def __init__(self, folder: Path, first: int = -1) -> None:
        """``first``: the version that the run begins with, of which it is not the maker; -1 if there is none."""
        self.restored = False
        """Whether the earlier run is in its folder again."""
        self._folder, self._first = folder, first
        self._report: Report = lambda event: None
        self._lock: IO[bytes] | None = None
        self._settling = threading.Lock()

    def set_aside(self) -> None:
        """Move the run that is in the folder aside, where it stays locked.

        Raises ConfigError, and touches nothing, if the folder holds no run or anything else, or if a
        run is on in it.
        """
        folder = self._folder
        _only_ours(folder)
        if not all((folder / name).is_file() for name in ("run.toml", "env.json")):
            raise ConfigError(f"--overwrite: {folder} holds no run; empty it, or use another --out")
        lock = take(folder)
        try:
            folder.rename(aside_of(folder))
        except OSError as error:
            lock.close()
            raise ConfigError(f"--overwrite: {folder} cannot be moved aside ({error.strerror}); use another --out") from None
        self._lock = lock

    def heed(self, report: Report) -> Report:
        """``report``, which also removes the earlier run as soon as events tell of the new one's first checkpoint."""
        self._report = report

        def heeded(event: dict[str, Any]) -> None:
            report(event)
            if event.get("version", -1) > self._first and newest_version(self._folder) > self._first:
                self.settle()

        return heeded

    def settle(self) -> None:
        """Remove the earlier run: the new one stands.  What cannot be removed is named, and is no error."""
        with self._settling:
            lock, self._lock = self._lock, None
        if lock is None:
            return
        with lock:
            try:
                remove(aside_of(self._folder))
            except (OSError, ConfigError) as error:
                self._note(f"the run that was replaced stays in {aside_of(self._folder)}: {error}")

    def restore(self) -> None:
        """Put the earlier run back in the place of the new one, unless somebody put other files there."""
        with self._settling:
            lock, self._lock = self._lock, None
        if lock is None:
            return
        with lock:
            try:
                remove(self._folder)
                aside_of(self._folder).rename(self._folder)
            except (OSError, ConfigError) as error:
                self._note(f"the run that was in {self._folder} lies in {aside_of(self._folder)}: {error}")
            else:
                self.restored = True
                self._note(f"the run that was in {self._folder} before is there again")

    def _note(self, text: str) -> None:
        self._report({"event": "note", "text": text})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None or newest_version(self._folder) > self._first:
            self.settle()
        else:
            self.restore()


_MADE = ("dataset_digest", "weights_digest", "version", "trajectories")


def concluded(folder: Path, result: dict[str, Any], evaluated: dict[str, Any]) -> dict[str, Any]:
    """What ``result.json`` is to hold: what the training made, and how it was evaluated.

    A run that had ended before and is resumed keeps the seconds that it took then; if nothing was
    collected or fitted since, it keeps everything but the evaluation.
    """
    try:
        earlier: dict[str, Any] = json.loads((folder / "result.json").read_text())
    except (FileNotFoundError, ValueError):
        return result | evaluated
    if any(earlier.get(name) != result.get(name) for name in _MADE) or result.get("repaired"):
        return result | {"seconds": earlier.get("seconds", result["seconds"])} | evaluated
    return earlier | {"folder": result["folder"]} | evaluated
