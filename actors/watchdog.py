"""The watchdog: a worker stuck in an environment says where, and ends.

It is a thread of C (``faulthandler``), so it barks although the interpreter's lock is held for
ever, and although the learner is away.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from icrl_dist import crashes


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
        if run is not None:
            self._file = _open(run, worker)
            faulthandler.enable(self._file)

    @contextlib.contextmanager
    def over(self, deadline_s: float) -> Iterator[None]:
        """Work for at most so many seconds."""
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
        faulthandler.disable()
        empty = not os.fstat(self._file.fileno()).st_size
        self._file.close()
        if empty:
            Path(self._file.name).unlink(missing_ok=True)  # the learner may have been quicker

    def _arm(self) -> None:
        if self._file is not None:
            faulthandler.dump_traceback_later(self._deadline_s, exit=True, file=self._file)

    def _disarm(self) -> None:
        if self._file is not None:
            faulthandler.cancel_dump_traceback_later()


def _open(run: Path, worker: str) -> IO[str]:
    with contextlib.suppress(OSError):  # then it goes to a temporary file
        if run.is_dir():
            path = crashes.stacks_of(run, worker)
            path.parent.mkdir(exist_ok=True)
            return path.open("w")
    return tempfile.NamedTemporaryFile("w", prefix=f"icrl-dist-{worker}-", suffix=".stacks", delete=False)
