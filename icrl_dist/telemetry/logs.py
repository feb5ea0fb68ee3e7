"""Log files: every line with its time in UTC, and every file with a bounded size."""

from __future__ import annotations

import contextlib
import logging
import logging.handlers
import shutil
import sys
import threading
from pathlib import Path
from types import TracebackType
from typing import Any

from icrl_dist.telemetry.budget import LogLines
from icrl_dist.telemetry.stamps import stamp

MAX_BYTES = 8 << 20
"""Size of a full log file; then it becomes ``NAME.1``."""
OLDER = 2
"""Full files of ``learner.log`` that are kept; of ``learner.err`` one is kept."""


def log_to(file: Path) -> None:
    """Write this process's log lines and warnings to ``file``, and the time before each traceback on standard error.

    The lines are those of ``LogLines``.  Does nothing if they are written elsewhere.
    """
    if logging.getLogger().handlers:
        return
    handler = logging.handlers.RotatingFileHandler(file, maxBytes=MAX_BYTES, backupCount=OLDER, encoding="utf-8")
    lines = LogLines()
    handler.setFormatter(lines)
    handler.addFilter(lines)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logging.captureWarnings(True)

    def raised(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        print(stamp(), file=sys.stderr)
        sys.__excepthook__(kind, error, trace)

    def raised_in_thread(arguments: Any) -> None:
        print(stamp(), file=sys.stderr)
        threading.__excepthook__(arguments)

    sys.excepthook, threading.excepthook = raised, raised_in_thread


def bound(path: Path) -> None:
    """If a file to which other processes append is full, move its content to ``NAME.1``.

    The file stays the same file, because its writers have it open for appending.
    """
    with contextlib.suppress(OSError):  # a log that cannot be bounded ends no run
        if path.stat().st_size > MAX_BYTES:
            shutil.copyfile(path, path.with_name(f"{path.name}.1"))
            with path.open("rb+") as file:
                file.truncate(0)
