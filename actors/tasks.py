"""Commands as Ray tasks: each runs on one core of some node of a cluster, and goes on elsewhere if its node is lost."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from actors.cluster import brief
from icrl_dist.telemetry import processes

STOP_S = 60.0
"""Seconds that a command has to end after its standard input was closed."""
_POLL_S = 0.2
LOST, CANCELLED = 255, 130
"""Exit codes of a task that Ray lost, and of one that was cancelled."""


class Task:
    """A command on the cluster."""

    def __init__(self, ray: Any, reference: Any) -> None:
        self._ray, self._reference = ray, reference
        self.error = ""
        """Why Ray could not run the command, in one line."""

    def poll(self) -> int | None:
        """The command's exit code; None while it waits for a core or runs; ``LOST`` if Ray could not run it."""
        if not self._ray.wait([self._reference], timeout=0)[0]:
            return None
        try:
            return int(self._ray.get(self._reference))
        except self._ray.exceptions.TaskCancelledError:
            return CANCELLED
        except Exception as error:
            self.error = brief(error)
            return LOST

    def stop(self) -> None:
        """Close the command's standard input, which ends it; it has ``STOP_S`` for that."""
        self._ray.cancel(self._reference, force=False)

    def kill(self) -> None:
        """End the task's process; the command's standard input closes with it."""
        self._ray.cancel(self._reference, force=True)


def start(ray: Any, words: Sequence[str], environment: Mapping[str, str], message: bytes, log: Path) -> Task:
    """Run this Python with ``words`` on a node with a free core.

    ``environment``: variables that are set there; ``message``: what its standard input begins with; ``log``: where its
    output is appended, in a folder that all nodes share.
    """
    remote = ray.remote(num_cpus=1)(_run)
    return Task(ray, remote.remote(list(words), dict(environment), message, str(log)))


def _run(words: list[str], environment: dict[str, str], message: bytes, log: str) -> int:
    """Runs on a node.  Returns the command's exit code.  Raises FileNotFoundError if the log's folder is not there."""
    folder = Path(log).parent
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: not on this node; use a folder that all nodes share")
    with Path(log).open("ab") as output:
        process = subprocess.Popen(
            processes.python(*words),
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env={**processes.environment(), **environment},
        )
    assert process.stdin is not None
    try:
        process.stdin.write(message)
        process.stdin.flush()
        while process.poll() is None:
            time.sleep(_POLL_S)  # a cancellation interrupts it
    finally:
        process.stdin.close()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    return process.returncode
