"""Crash records: what went wrong in a worker, as files of the run folder that outlive it.

``RUN_DIR/crashes`` holds ``WORKER-N.json``, one for each time that a worker raised or vanished,
and ``WORKER.stacks``, where its threads stood when it was stuck or crashed.
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

from icrl_dist.types import Identity, Job

_LINE, _TEXT = 1_000, 20_000
"""A record keeps so many characters of an exception, and of a traceback's end."""


def folder_of(run: Path) -> Path:
    """Where a run folder keeps its crash records."""
    return run / "crashes"


def stacks_of(run: Path, worker: str) -> Path:
    """Where a worker's stacks go."""
    return folder_of(run) / f"{worker}.stacks"


def sweep(run: Path) -> None:
    """Remove the stacks files in which nothing stands, at a run's end."""
    for path in folder_of(run).glob("*.stacks"):
        with contextlib.suppress(FileNotFoundError):  # its worker was quicker
            if not path.stat().st_size:
                path.unlink()


def memory() -> dict[str, float]:
    """This process's resident memory now and at its peak, in MB."""
    now = psutil.Process().memory_info().rss / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # which the kernel counts less often
    return {"memory_mb": round(now, 1), "peak_mb": round(max(now, peak), 1)}


def raised(worker: str, job: Job, identity: Identity | None, error: BaseException) -> dict[str, Any]:
    """The record of a job that raised while ``identity`` was under way."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return {
        "what": "raised",
        "worker": worker,
        "time": time.time(),
        "job": job.label,
        "identity": str(identity) if identity else "",
        "exception": _text(f"{type(error).__name__}: {error}"[:_LINE] + f" ({Path(place.filename).name}:{place.lineno})"),
        "seed": job.seed,
        "spawn_key": list(identity.key()) if identity else [],
        "policy_version": job.policy_version,
        "variations": len(job.variations),
        **memory(),
        "traceback": _text("".join(traceback.format_exception(error))[-_TEXT:]),
    }


def write(run: Path, record: dict[str, Any]) -> Path:
    """Keep a record under its worker's next free number; returns the file."""
    folder = folder_of(run)
    folder.mkdir(exist_ok=True)
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


def _text(text: str) -> str:
    """What any wire and file can hold: an exception's words may be no valid text."""
    return text.encode("utf-8", "backslashreplace").decode()


def predecessor(worker: str) -> str | None:
    """Whose place it takes: a worker's second life is named ``w0-1``, its third ``w0-2``; None for a first life."""
    name, _, life = worker.rpartition("-")
    if not (name and life.isascii() and life.isdigit() and 0 < int(life) < 10**6):
        return None
    return name if int(life) == 1 else f"{name}-{int(life) - 1}"
