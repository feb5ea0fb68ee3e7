"""Ray on this machine alone.  Ray comes as an argument: only ``fleet`` imports it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from typing import Any

import psutil

TRIES = 3
"""Ray is started so often before a run gives up."""


def begin(ray: Any, note: Callable[[str], None], stopped: Callable[[], bool] = lambda: False, **options: Any) -> None:
    """Start Ray with these options of ``ray.init``, and again if it did not come up.

    Ray's node ends itself, for good, when one of the processes that it starts takes more than 30 s,
    as may happen on a machine that is busy; only a new Ray helps.  Raises RuntimeError after ``TRIES``,
    or if it did not come up and ``stopped``.
    """
    for number in range(1, TRIES + 1):
        before = psutil.Process().children()
        try:
            ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR, **options)
            return
        except Exception as error:  # of no kind that Ray would give a name
            ray.shutdown()
            _end(set(psutil.Process().children()) - set(before))  # it does not end what it had started by then
            said = f"Ray did not start on this machine ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
            if stopped() or number == TRIES:
                raise RuntimeError(
                    f"{said}, tried {number} times; its own words are in /tmp/ray/session_latest/logs"
                ) from error
            note(f"{said}: starting it again, {number + 1} of {TRIES}")


def _end(processes: set[psutil.Process]) -> None:
    family = list(processes)
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            family += process.children(recursive=True)
    for process in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(family, timeout=5.0)
