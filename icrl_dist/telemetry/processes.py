"""A training's processes, as other programs see them."""

from __future__ import annotations

import contextlib

import psutil


def is_learner(process: psutil.Process) -> bool:
    """Whether this is the learner of a run."""
    return "-m learner" in _words(process)


def is_worker(process: psutil.Process, spare: bool = False) -> bool:
    """Whether this is a worker at work, or with ``spare`` also one that waits to replace another."""
    return ("WorkerActor" if spare else "WorkerActor.work") in _words(process)


def _words(process: psutil.Process) -> str:
    """Its command line; empty if it is gone or not ours to look at."""
    with contextlib.suppress(psutil.Error):
        return " ".join(process.cmdline())
    return ""
