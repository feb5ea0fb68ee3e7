"""Ray on one computer.  Ray is an argument: only ``fleet`` imports it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from typing import Any

import psutil

TRIES = 3
"""Attempts to start Ray before a run fails."""


def start_ray(ray: Any, note: Callable[[str], None], stopped: Callable[[], bool] = lambda: False, **options: Any) -> None:
    """Start Ray with these options of ``ray.init``; try again if it does not start.

    Ray's node process ends for good when one of the processes that it starts takes more than 30 s, which
    happens on a busy computer; only a new Ray helps.  ``note`` is called with a line before each new
    attempt.  Raises RuntimeError after ``TRIES`` attempts, or after a failed one if ``stopped()`` is true.
    Raises SystemExit at SIGTERM, by the handler that Ray sets when it starts.
    """
    for number in range(1, TRIES + 1):
        before = psutil.Process().children()
        try:
            ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR, **options)
            return
        except (Exception, SystemExit) as error:  # Ray raises no specific type
            ray.shutdown()
            _end(set(psutil.Process().children()) - set(before))  # Ray leaves what it had already started
            if isinstance(error, SystemExit):
                raise
            cause = str(error).splitlines()[0] if str(error) else type(error).__name__
            text = f"Ray did not start on this machine ({cause})"
            if stopped() or number == TRIES:
                raise RuntimeError(f"{text}, tried {number} times; its logs are in /tmp/ray/session_latest/logs") from error
            note(f"{text}: starting it again, {number + 1} of {TRIES}")


def _end(processes: set[psutil.Process]) -> None:
    family = list(processes)
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            family += process.children(recursive=True)
    for process in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(family, timeout=5.0)
