"""The names of all files that a run folder gets, in this file only, and the refusal of odd files in their places."""

from __future__ import annotations

import os
import re
from pathlib import Path

from icrl_dist.storage.files import StoreError, require_plain

_REPORTS = (
    r"(online|posterior|attack|worst)-(.+-)?T\d+-[0-9a-f]*-.+\.(json|png)|(online|posterior)\.json|(adaptation|posterior)\.png"
)
NAMES = {
    "checkpoints/report": _REPORTS,
    "checkpoints": r"version-\d+\.npz|partial\.npz|agent\.npz",
    "crashes": r".+-\d+\.json|.+\.stacks",
    "dataset": r"segment-\d+\.frames",
    "report": _REPORTS,
    "results": r"(online|offline|posterior|attack|worst|label_quality|experts)-[0-9a-f]{8}-\d{8}T\d{6}\.\d{6}Z\.parquet",
    "tensorboard": r"events\.out\.tfevents\..+",
    "": r"(run\.toml|(env|fork|result)\.json|(metrics\.jsonl|learner\.(log|err))(\.\d)?|agent\.npz|endpoint"
    r"|\.(lock|replacement|beginning))",
}
"""The folders within a run folder, the deepest first, each with a pattern of the file names that this program writes."""


def owned(place: str, name: str) -> bool:
    """Whether this program writes a file of this name into ``place``, a folder within a run folder ("": the run folder).

    This includes the ``.part`` files that a killed ``files.atomic_write`` leaves behind.
    """
    pattern = NAMES[place]
    return re.fullmatch(rf"(?s:{pattern}|\.({pattern})\.\d+\.part)", name) is not None


def sweep(folder: Path) -> None:
    """Remove the parts of interrupted writes: those of processes that do not run on this node any more."""
    for place in NAMES:
        for path in (folder / place).glob(".*.part"):
            number = path.name.removesuffix(".part").rpartition(".")[2]
            if owned(place, path.name) and not Path("/proc", number).exists():
                path.unlink(missing_ok=True)


def refuse_odd_files(folder: Path) -> None:
    """Raises StoreError, with the name, for a link, a pipe or a folder where this program has a file, and for a linked folder.

    A link can lead out of the run folder, and a pipe is waited for without end.  Files of other names are not looked at.
    """
    for place in NAMES:
        directory = folder / place
        if place and directory.is_symlink():
            raise StoreError(f"{directory}: is a link, expected a folder: move it away, or put the folder itself there")
        if not os.path.lexists(directory):
            continue
        if not directory.is_dir():
            raise StoreError(f"{directory}: is no folder: move it away")
        try:
            paths = sorted(directory.iterdir())
        except OSError as error:
            raise StoreError(f"{directory}: cannot be read ({error.strerror}): make it readable") from None
        for path in paths:
            if owned(place, path.name):
                require_plain(path)
