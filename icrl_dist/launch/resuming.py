"""Which run a command goes on with, and whether that run is finished."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from icrl_dist.config.resuming import differences
from icrl_dist.config.run import ConfigError, Run, load_folder, run_folder_of
from icrl_dist.launch.run_folder import aside_of
from icrl_dist.storage.checkpoint import newest_version
from icrl_dist.storage.fork import parse_source
from icrl_dist.stream.schema import as_data


def default_folder(run: str | Path, source: str | Path | None = None) -> Path:
    """The run folder of a packaged run or a run file, or of a fork if ``run`` is empty."""
    if Path(run).stem or source is None:
        return Path("runs") / Path(run).stem
    folder, version = parse_source(str(source))
    return Path("runs") / f"{folder.name}-from-{version}"


def place(run: str | Path, out: str | Path | None, source: str | Path | None, resume: bool) -> Path:
    """The run folder of a command.

    It is ``out``, with ``~`` expanded; else, to ``resume``, the run folder that RUN names (``runs/demo`` or
    ``runs/demo/run.toml``); else the default.  Raises ConfigError if RUN and ``out`` are two run folders, and for the
    ``~`` of an unknown user.
    """
    named = run_folder_of(run) if resume else None
    if out is None:
        return default_folder(run, source) if named is None else named
    try:
        folder = Path(out).expanduser()
    except RuntimeError as error:
        raise ConfigError(f"--out {out}: {error}") from None
    if named is not None and Path(run).is_dir() and folder.resolve() != named.resolve():
        raise ConfigError(f"{run} --out {out}: RUN and --out are two run folders; leave out --out to continue {named}")
    return folder


def finished(run: Run, folder: Path) -> dict[str, Any] | None:
    """The content of ``result.json`` if the folder holds this run and it has ended, its evaluation included; else None.

    A run with other numbers, another evaluation or a missing checkpoint, and a folder whose replacement was
    interrupted, are not finished: to resume them says what is wrong, or does what is missing.
    """
    if not (folder / "run.toml").is_file() or aside_of(folder).exists():
        return None
    there = load_folder(folder)
    try:
        result: dict[str, Any] = json.loads((folder / "result.json").read_text())
        complete = newest_version(folder) >= result["version"] and result["evaluate"] == as_data(run.evaluate)
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return result if complete and not differences(there, run) else None


def holds(run: Run, folder: Path) -> bool:
    """Whether the folder holds this run, so that ``--resume`` continues it."""
    with contextlib.suppress(ConfigError):
        return (folder / "run.toml").is_file() and not differences(load_folder(folder), run)
    return False
