"""The runs of a folder, read from their files: name, method, problem, state and held-out result of each."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.monitor import headline
from icrl_dist.monitor.evaluation import held_out
from icrl_dist.storage.files import StoreError, held
from icrl_dist.stream.excerpts import plain
from icrl_dist.telemetry import metric_rows

_log = logging.getLogger(__name__)

MAX_RUNS = 200
"""Runs in a list, the newest."""
_PERIOD_S = 2.0
"""Seconds between two looks at the folder."""
_TAIL_BYTES = 1 << 16
"""Bytes at the end of the metrics in which the event that ended the run is searched."""
_ENDS = ("finished", "interrupted", "failed")


@dataclass(frozen=True)
class ListedRun:
    """One run folder."""

    name: str
    """Name of the folder as plain text, unique in the list; the only name under which a view can request the run."""
    folder: Path
    began: float
    """When it was begun or resumed, Unix seconds."""
    held: bool
    """Whether a process works on it."""
    live: bool
    """Whether this process is a learner, to which a view can connect."""


def find(folder: Path) -> list[ListedRun]:
    """The runs in a folder, newest first, those on which a process works before the others; none if it does not exist.

    A folder that is a run itself has one run.  Symbolic links are left out, so every run lies in the folder.
    """
    found: dict[str, ListedRun] = {}
    for path in _run_folders(folder):
        try:
            files = [file for file in (path / "run.toml", path / "endpoint") if file.is_file()]
            began, busy = max(file.stat().st_mtime for file in files), held(path)
            live = busy and len(files) == 2
        except (OSError, ValueError):  # removed or replaced at this moment, or not readable for this user
            continue
        name = shown = plain(path.absolute().name)
        number = 1
        while name in found:  # two names that differ only in what cannot be shown
            number += 1
            name = f"{shown} ({number})"
        found[name] = ListedRun(name, path, began, busy, live)
    return sorted(found.values(), key=lambda run: (run.held, run.began), reverse=True)


def _run_folders(folder: Path) -> Iterator[Path]:
    if (folder / "run.toml").is_file():
        yield folder
        return
    try:
        children = sorted(folder.iterdir())
    except OSError:
        return
    for child in children:
        if not child.name.startswith(".") and not child.is_symlink() and (child / "run.toml").is_file():
            yield child


def state(run: ListedRun) -> str:
    """``training``, ``evaluating``, ``starting``, ``finished``, ``interrupted`` or ``failed``."""
    if run.live:
        return "training"
    newest = ""  # how the run ended, or ``training`` if it went on after that
    for row in metric_rows.read(run.folder, _TAIL_BYTES):
        if row.get("what") in _ENDS:
            newest = str(row["what"])
        elif row["stage"] == "ingest" or row["stage"].startswith("fit/"):
            newest = "training"
    if not run.held:
        return newest if newest in _ENDS else "interrupted"
    if newest == "finished":
        return "evaluating"
    return "training" if newest == "training" else "starting"  # training in one process, to which no view can connect


class RunList:
    """Keeps the list of a folder up to date on its own thread; held-out results follow once they are computed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._worth: dict[Path, tuple[object, str]] = {}
        """What is shown as the held-out result of a run folder, and the result files that it was computed from."""
        self._about: dict[Path, tuple[float, dict[str, str]]] = {}
        self._ended = threading.Event()
        self._rows: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._watch, name="run-list", daemon=True)
        self.refresh()
        self._thread.start()

    def refresh(self) -> None:
        """Look at the folder now; held-out results are those that were computed before."""
        self._rows = [self._row(run) for run in find(self._folder)]

    def listed(self) -> dict[str, Any]:
        """The list as JSON values: ``folder``, ``newest`` (a name, or null), ``runs`` (newest first), ``left_out``."""
        rows = self._rows
        newest = rows[0]["name"] if rows else None
        shown = rows[:MAX_RUNS]
        return {"folder": plain(str(self._folder)), "newest": newest, "runs": shown, "left_out": len(rows) - len(shown)}

    def _row(self, run: ListedRun) -> dict[str, Any]:
        about = self._about.get(run.folder)
        if about is None or about[0] != run.began:
            about = self._about[run.folder] = run.began, _about(run.folder)
        worth = self._worth.get(run.folder, (None, ""))[1]
        return {"name": run.name, "state": state(run), "began": run.began, "held_out": worth, **about[1]}

    def _watch(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            try:
                self.refresh()
                self._evaluate()
            except Exception:
                _log.exception("the list of runs in %s could not be refreshed", self._folder)

    def _evaluate(self) -> None:
        """Compute the held-out results of the runs whose result files have changed."""
        for run in find(self._folder)[:MAX_RUNS]:
            if self._ended.is_set():
                return
            files = [
                (file.name, file.stat().st_mtime_ns, file.stat().st_size)
                for file in sorted((run.folder / "results").glob("online-*.parquet"))
            ]
            if self._worth.get(run.folder, ([], ""))[0] == files:
                continue
            try:
                found = held_out(run.folder)
                text = "" if found is None else headline.worth({"state": "finished"}, found, True)
            except (ConfigError, StoreError, OSError) as error:
                text = plain(f"not readable: {error}")
            self._worth[run.folder] = files, text
            self.refresh()

    def close(self) -> None:
        self._ended.set()
        self._thread.join(10.0)


def _about(folder: Path) -> dict[str, str]:
    """Method and problem of a run folder, and in ``note`` why they cannot be read."""
    try:
        run = load_folder(folder)
    except (ConfigError, OSError) as error:
        return {"method": "", "problem": "", "note": plain(str(error))}
    return {"method": plain(run.method), "problem": plain(run.problem), "note": ""}
