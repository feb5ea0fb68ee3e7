"""Log files: every line with its time in UTC, and every file with a bounded size."""

from __future__ import annotations

import contextlib
import logging
import logging.handlers
import shutil
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

MAX_BYTES = 8 << 20
"""Size of a full log file; then it becomes ``NAME.1``."""
OLDER = 2
"""Full files of ``learner.log`` that are kept; of ``learner.err`` one is kept."""


def stamp(at: float | None = None) -> str:
    """A time (Unix seconds; None: now) as every log line and message has it: ``2026-05-17T09:30:00Z``."""
    return datetime.fromtimestamp(time.time() if at is None else at, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


class LogFormat(logging.Formatter):
    """``TIME message``."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(message)s")

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # noqa: N802
        return stamp(record.created)


def log_to(file: Path) -> None:
    """Write this process's log lines and warnings to ``file``, and the time before each traceback on standard error."""
    handler = logging.handlers.RotatingFileHandler(file, maxBytes=MAX_BYTES, backupCount=OLDER, encoding="utf-8")
    handler.setFormatter(LogFormat())
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
