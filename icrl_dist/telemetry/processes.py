"""The Python processes of a training run: how they are started, and how they are recognized."""

from __future__ import annotations

import contextlib
import importlib
import os
import site
import sys
import sysconfig
from pathlib import Path

import psutil


def python(*words: str) -> list[str]:
    """The command that runs this Python with these words, such as ``-m`` and a module; start it with ``environment``.

    The current folder is not searched for modules (``-P``): a file ``random.py`` of the user, who may start a run
    anywhere, would otherwise be imported in place of Python's own.
    """
    return [sys.executable, "-P", *words]


def environment() -> dict[str, str]:
    """The environment variables for ``python``: this process's own, and where the code of this package is, if needed.

    Idle threads of torch sleep (docs/decisions/073-openmp-wait-policy.md).  Empty entries of PYTHONPATH, which mean the
    current folder, are left out.
    """
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    path = os.pathsep.join(filter(None, [*code_path(), *given]))
    return {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **({"PYTHONPATH": path} if path else {})}


def code_path() -> list[str]:
    """The folder of this package's code, for a search path; empty if the code is installed where Python always looks.

    So a child process runs the code of its parent also in a source checkout.
    """
    root = Path(__file__).resolve().parents[2]
    places = [*sysconfig.get_paths().values(), *site.getsitepackages(), site.getusersitepackages()]
    return [] if root in [Path(place).resolve() for place in places] else [str(root)]


def import_torch() -> None:
    """Import torch so that its idle threads sleep, if this process has not imported it and has set no policy.

    OpenMP reads the variable once, when torch loads it; for other libraries and child processes it stays unset.
    """
    if "torch" in sys.modules or "OMP_WAIT_POLICY" in os.environ:
        return
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    try:
        importlib.import_module("torch")
    finally:
        del os.environ["OMP_WAIT_POLICY"]


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
