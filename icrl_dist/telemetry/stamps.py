"""The one format of times in log lines and messages."""

from __future__ import annotations

import time
from datetime import UTC, datetime


def stamp(at: float | None = None) -> str:
    """A time (Unix seconds; None: now) as every log line and message has it: ``2026-05-17T09:30:00Z``."""
    return datetime.fromtimestamp(time.time() if at is None else at, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
