"""What a run that ended early left in its folder: what ``--resume`` continues from, or nothing."""

from __future__ import annotations

import contextlib
from pathlib import Path

from icrl_dist.config.run import ConfigError
from icrl_dist.launch import run_folder
from icrl_dist.storage import segment
from icrl_dist.storage.checkpoint import newest_version, partial_file

_WITHOUT_RESULT = {"run.toml", "env.json", "metrics.jsonl", "learner.log", "endpoint", ".lock"}
"""Files that a run writes before it has collected or fitted anything."""


def holdings(folder: Path) -> str:
    """What ``--resume`` would continue from: ``the last checkpoint``, ``the 140 stored trajectories``; empty for nothing."""
    if newest_version(folder) >= 0 or partial_file(folder).exists():
        return "the last checkpoint"
    with contextlib.suppress(OSError):
        if count := sum(len(segment.scan(path).frames) for path in sorted((folder / "dataset").glob("segment-*.frames"))):
            return f"the {count} stored trajectories"
    return ""


def remove_if_empty(folder: Path) -> bool:
    """Remove a run folder in which nothing was collected, fitted or reported, so that the same command can be repeated.

    Returns whether it is gone.  An error output or a damaged segment is no result, and is kept: it shows a cause.
    """
    files = [path for path in folder.rglob("*") if not path.is_dir() and path.parent != folder / "tensorboard"]
    if holdings(folder) or any(
        path.stat().st_size and path.relative_to(folder).as_posix() not in _WITHOUT_RESULT for path in files
    ):
        return False
    with contextlib.suppress(ConfigError, OSError):  # it holds a file of the user's
        run_folder.remove(folder)
    return not folder.exists()
