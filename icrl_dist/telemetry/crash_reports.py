"""Crash records: files of the run folder about errors and deaths of workers.

``RUN_DIR/crashes`` holds ``WORKER-N.json``, a file for each time that a worker raised an error or
disappeared, and ``WORKER.stacks``, the stacks of its threads when it was stuck or crashed.
"""

from __future__ import annotations

import contextlib
import json
import resource
import time
import traceback
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.stream.excerpts import plain
from icrl_dist.stream.messages import LINE, TRACEBACK
from icrl_dist.types import Identity, Job

MAX_FILES = 1_000
"""Files in a run's folder of crash records; later records are not written."""


def folder_of(run: Path) -> Path:
    """The folder of a run's crash records."""
    return run / "crashes"


def stacks_of(run: Path, worker: str) -> Path:
    """The file of a worker's stacks."""
    return folder_of(run) / f"{worker}.stacks"


def sweep(run: Path) -> None:
    """Remove empty stacks files, at a run's end."""
    for path in folder_of(run).glob("*.stacks"):
        with contextlib.suppress(FileNotFoundError):  # its worker has removed it
            if not path.stat().st_size:
                path.unlink()


def memory() -> dict[str, float]:
    """This process's resident memory now and at its peak, in MB."""
    now = psutil.Process().memory_info().rss / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # the kernel updates it less often
    return {"memory_mb": round(now, 1), "peak_mb": round(max(now, peak), 1)}


def raised(
    worker: str, label: str, error: BaseException, job: Job | None = None, identity: Identity | None = None
) -> dict[str, Any]:
    """The record, a ``messages.CrashRecord``, of a job that raised ``error`` while it made the trajectory ``identity``.

    ``label``: the job's name as text; ``job``: None if it could not be decoded.
    """
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = plain(f" ({Path(place.filename).name}:{place.lineno})")
    of_job = {"seed": job.seed, "policy_version": job.policy_version, "variations": len(job.variations)} if job else {}
    return {
        "what": "raised",
        "worker": worker,
        "time": time.time(),
        "job": label,
        "identity": str(identity) if identity else "",
        "exception": plain(f"{type(error).__name__}: {error}", LINE - len(where)) + where,
        "spawn_key": list(identity.key()) if identity else [],
        **of_job,
        **memory(),
        "traceback": _encodable("".join(traceback.format_exception(error))[-TRACEBACK:])[-TRACEBACK:],
    }


def write(run: Path, record: dict[str, Any]) -> Path:
    """Write a record to its worker's next free file name; returns the file.

    Raises OSError if it cannot be written, also if the folder holds ``MAX_FILES`` files.
    """
    folder = folder_of(run)
    folder.mkdir(exist_ok=True)
    if sum(1 for _ in folder.iterdir()) >= MAX_FILES:
        raise OSError(f"{folder} holds {MAX_FILES} files, the limit: move them away to keep further ones")
    text, number = json.dumps(record, indent=1) + "\n", 1
    while True:
        path = folder / f"{record['worker']}-{number}.json"
        try:
            with path.open("x") as file:
                file.write(text)
        except FileExistsError:
            number += 1
        else:
            return path


def _encodable(text: str) -> str:
    """Text that UTF-8 can encode: an exception's text may hold lone surrogates."""
    return text.encode("utf-8", "backslashreplace").decode()


def predecessor(worker: str) -> str | None:
    """The worker that this one replaces: ``w0-1`` replaces ``w0``, ``w0-2`` replaces ``w0-1``; None for ``w0``."""
    name, _, number = worker.rpartition("-")
    if not (name and number.isascii() and number.isdigit() and 0 < int(number) < 10**6):
        return None
    return name if int(number) == 1 else f"{name}-{int(number) - 1}"
