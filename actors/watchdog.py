"""The watchdog: a worker stuck in an environment says where, and ends, although the learner is away.

There are two.  A thread of Python's barks first: it holds the interpreter's lock meanwhile, so that
the stacks that it writes stand still.  Where that lock is held for ever, a thread of C barks
(``faulthandler``) ``GRACE_S`` later: then no other thread can run, and the stacks stand still too.
While others run, the thread of C might read a stack that is just changing, and crash.
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
"""Seconds that the thread of Python's has to get the interpreter's lock and to write."""


class Watchdog:
    """Ends this process, its stacks written to a file, when work outlasts its deadline.

    Also keeps the stacks of a crash in C, such as a segmentation fault.  There is one a process:
    ``faulthandler`` knows no other.
    """

    def __init__(self, run: Path | None, worker: str) -> None:
        """The stacks go into the run folder where it exists on this machine, else to a temporary file.

        Without ``run`` there is no watchdog: a worker that is a thread among others must not end
        their process.
        """
        self._file: IO[str] | None = None
        self._deadline_s = 0.0
        self._changed = threading.Condition()
        self._due: float | None = None
        """When it barks, by ``time.monotonic``; None while nothing is to be watched."""
        self._over = False
        if run is not None:
            self._file = _open(run, worker)
            faulthandler.enable(self._file)
            threading.Thread(target=self._watch, name="watchdog", daemon=True).start()

    @contextlib.contextmanager
    def over(self, deadline_s: float) -> Iterator[None]:
        """Work for at most so many seconds."""
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
        """Within ``over``: wait for others, however long; then the time runs anew."""
        self._disarm()
        try:
            yield
        finally:
            self._arm()

    def close(self) -> None:
        """Let go of the file, and leave none behind in which nothing stands."""
        if self._file is None:
            return
        with self._changed:
            self._over = True
            self._changed.notify()
        faulthandler.disable()
        empty = not os.fstat(self._file.fileno()).st_size
        self._file.close()
        if empty:
            Path(self._file.name).unlink(missing_ok=True)  # the learner may have been quicker

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
        """Sleeps as long as nothing can be due, and is woken only for a deadline shorter than those before."""
        with self._changed:
            while not self._over:
                left = self._deadline_s or None if self._due is None else self._due - time.monotonic()
                if left is None or left > 0:
                    self._changed.wait(left)
                else:
                    self._bark()

    def _bark(self) -> None:
        assert self._file is not None
        self._file.write(f"Timeout ({datetime.timedelta(seconds=self._deadline_s)})!\n")
        self._file.flush()
        faulthandler.dump_traceback(self._file)
        os._exit(1)


def _open(run: Path, worker: str) -> IO[str]:
    with contextlib.suppress(OSError):  # then it goes to a temporary file
        if run.is_dir():
            path = crash_reports.stacks_of(run, worker)
            path.parent.mkdir(exist_ok=True)
            return path.open("w")
    return tempfile.NamedTemporaryFile("w", prefix=f"icrl-dist-{worker}-", suffix=".stacks", delete=False)
