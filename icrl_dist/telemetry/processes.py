"""Recognize the processes of a training run by their command lines."""

from __future__ import annotations

import contextlib

import psutil


def is_learner(process: psutil.Process) -> bool:
    """Whether this is a run's learner process."""
    return "-m learner" in _command_line(process)


def is_worker(process: psutil.Process, spare: bool = False) -> bool:
    """Whether this is a busy worker process, or with ``spare`` also one that waits to replace another."""
    return ("WorkerActor" if spare else "WorkerActor.work") in _command_line(process)


def _command_line(process: psutil.Process) -> str:
    """The command line; empty if the process is gone or not accessible."""
    with contextlib.suppress(psutil.Error):
        return " ".join(process.cmdline())
    return ""
