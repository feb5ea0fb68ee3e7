"""A clock that stands still while this process is stopped (Ctrl-Z, a suspended computer), for time limits."""

from __future__ import annotations

import time

GAP_S = 5.0
"""Two readings further apart than this were separated by a stop; readers read at least once a second."""


class RunningTime:
    """Seconds for which this process has run, as far as its readings show.

    A limit measured on it never ends because the process was stopped: what it waits for was stopped with it, or has
    arrived meanwhile and has not been read.
    """

    def __init__(self) -> None:
        self._read = time.monotonic()
        self._seconds = 0.0

    def __call__(self) -> float:
        """The seconds so far; a gap of more than ``GAP_S`` since the last reading counts as ``GAP_S``."""
        now = time.monotonic()
        self._seconds += min(now - self._read, GAP_S)
        self._read = now
        return self._seconds
