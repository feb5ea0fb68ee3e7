"""Watchdog: ends a worker that is stuck in an environment and writes its stacks, without the learner.

Two timers watch a deadline.  A Python thread acts first: it holds the interpreter lock, so no stack
changes while it writes them.  If another thread never releases that lock, a C thread (``faulthandler``)
acts ``GRACE_S`` later: then no other Python thread runs, so no stack changes either.  The C thread is not
the first because it may read a stack while its thread changes it, and crash.
"""

from __future__ import annotations

import contextlib
import datetime
import faulthandler
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from icrl_dist.telemetry import crash_reports

GRACE_S = 2.0
"""Seconds that the Python thread has to get the interpreter lock and to write the stacks."""


class Watchdog:
    """Writes the stacks of this process to a file and ends it when work takes longer than its deadline.

    Also writes the stacks of a crash in C, such as a segmentation fault.  A process can have only one
    watchdog, because ``faulthandler`` has one state per process.
    """

    def __init__(self, run: Path | None, worker: str) -> None:
        """The stacks go into the run folder ``run`` if this node has it, else into a temporary file.

        If ``run`` is None the watchdog does nothing: a worker that is one thread of a process must not
        end that process.
        """
        self._file: IO[str] | None = None
        self._deadline_s = 0.0
        self._changed = threading.Condition()
        self._due: float | None = None
        """Time of the deadline (``time.monotonic``); None while no work is watched."""
        self._closed = False
        if run is not None:
            self._file = _open(run, worker)
            faulthandler.enable(self._file)
            threading.Thread(target=self._watch, name="watchdog", daemon=True).start()

    @contextlib.contextmanager
    def deadline(self, deadline_s: float) -> Iterator[None]:
        """Allow the enclosed work ``deadline_s`` seconds."""
        with self._changed:
            if not 0 < self._deadline_s <= deadline_s:
                self._changed.notify()
            self._deadline_s = deadline_s
        self._arm()
        try:
            yield
        finally:
            self._disarm()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Within ``deadline``: the enclosed waiting has no limit; afterwards the time starts again."""
        self._disarm()
        try:
            yield
        finally:
            self._arm()

    def close(self) -> None:
        """Close the file; remove it if it is empty."""
        if self._file is None:
            return
        with self._changed:
            self._closed = True
            self._changed.notify()
        faulthandler.disable()
        empty = not os.fstat(self._file.fileno()).st_size
        self._file.close()
        if empty:
            Path(self._file.name).unlink(missing_ok=True)  # the learner may have removed it already

    def _arm(self) -> None:
        if self._file is not None:
            with self._changed:
                self._due = time.monotonic() + self._deadline_s
            faulthandler.dump_traceback_later(self._deadline_s + GRACE_S, exit=True, file=self._file)

    def _disarm(self) -> None:
        if self._file is not None:
            faulthandler.cancel_dump_traceback_later()
            with self._changed:
                self._due = None

    def _watch(self) -> None:
        """Sleep until the next possible deadline; a shorter deadline than before wakes this thread earlier."""
        with self._changed:
            while not self._closed:
                left = self._deadline_s or None if self._due is None else self._due - time.monotonic()
                if left is None or left > 0:
                    self._changed.wait(left)
                else:
                    self._dump_and_exit()

    def _dump_and_exit(self) -> None:
        assert self._file is not None
        self._file.write(f"Timeout ({datetime.timedelta(seconds=self._deadline_s)})!\n")
        self._file.flush()
        faulthandler.dump_traceback(self._file)
        os._exit(1)


def _open(run: Path, worker: str) -> IO[str]:
    with contextlib.suppress(OSError):  # then a temporary file is used
        if run.is_dir():
            path = crash_reports.stacks_of(run, worker)
            path.parent.mkdir(exist_ok=True)
            return path.open("w")
    return tempfile.NamedTemporaryFile("w", prefix=f"icrl-dist-{worker}-", suffix=".stacks", delete=False)
