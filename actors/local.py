"""Ray in this process and on this computer.  Ray is an argument: only ``fleet`` imports it."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

import psutil

from icrl_dist.config.run import ConfigError

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


def refuse_running_session() -> None:
    """Raises ConfigError if this process already uses Ray: a run would end that session, and all its work, with its own."""
    ray = sys.modules.get("ray")
    if ray is not None and ray.is_initialized():
        raise ConfigError(
            "engine 'ray': this process already uses Ray, and a run starts and ends a session of its own: call ray.shutdown() "
            "first, train in another process (`icrl-dist train`), or use engine='inline'"
        )


def variables() -> dict[str, str]:
    """The environment variables that Ray reads and sets."""
    return {name: value for name, value in os.environ.items() if name.startswith("RAY_") or name == "PYTHONBREAKPOINT"}


def restore_variables(former: Mapping[str, str]) -> None:
    """Set Ray's environment variables as ``variables`` returned them."""
    for name in variables():
        del os.environ[name]
    os.environ.update(former)
