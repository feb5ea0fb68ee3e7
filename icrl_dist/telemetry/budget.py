"""Limits on how often something is reported that other processes can cause, and the log lines of a process under them."""

from __future__ import annotations

import logging
import time

from icrl_dist.stream.excerpts import plain_lines
from icrl_dist.telemetry.stamps import stamp


class Budget:
    """Allows ``burst`` events at once, and ``per_s`` a second after them.  Safe for one thread at a time."""

    def __init__(self, burst: int, per_s: float) -> None:
        self._burst, self._per_s = burst, per_s
        self._left, self._since = float(burst), time.monotonic()
        self.left_out = 0
        """Events that were not allowed since the last one that was."""

    def allows(self) -> bool:
        """Whether one more event is allowed now."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + (now - self._since) * self._per_s)
        self._since = now
        if self._left < 1:
            self.left_out += 1
            return False
        self._left -= 1
        return True

    def note(self) -> str:
        """A text about the events that were left out, for the next event; empty if there are none."""
        count, self.left_out = self.left_out, 0
        return f" ({count} more of these were left out)" if count else ""


class LogLines(logging.Formatter):
    """Log lines with the time, printable whatever their texts hold, and few of each line of the code.

    A handler uses it as its formatter and as its filter.
    """

    def __init__(self, burst: int = 100, per_s: float = 0.2) -> None:
        super().__init__("%(asctime)s %(message)s")
        self._rates, self._budgets = (burst, per_s), dict[tuple[str, int], Budget]()

    def filter(self, record: logging.LogRecord) -> bool:
        return self._budget(record).allows()

    def format(self, record: logging.LogRecord) -> str:
        return plain_lines(super().format(record)) + self._budget(record).note()

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # noqa: N802
        return stamp(record.created)

    def _budget(self, record: logging.LogRecord) -> Budget:
        return self._budgets.setdefault((record.pathname, record.lineno), Budget(*self._rates))
