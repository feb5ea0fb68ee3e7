"""Progress of a run in the terminal: one bar for the present stage, and events as lines."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from icrl_dist.console.event_lines import EventLines
from icrl_dist.console.stage_rows import StageRow, duration, name_of
from icrl_dist.console.terminal import PlainConsole
from icrl_dist.stream.excerpts import plain
from icrl_dist.telemetry.stamps import stamp

ReportEvent = Callable[[dict[str, Any]], None]
"""Shows one event of a run, such as ``{"event": "note", "text": ...}``."""
Show = bool | ReportEvent
"""What a function shows of its progress: True for lines and bars on standard output, False for nothing, or a receiver."""

_PERIOD_S, _MAX_PERIOD_S = 10.0, 600.0
"""Least and largest number of seconds between progress lines where there is no terminal."""
_LINES = 30
"""Lines of progress in the first five minutes; later ones are this share of the time apart."""
_LONGEST = 2_000
"""Characters of a line."""


class Display:
    """Shows a run's events as bars and lines, as a context.

    In a terminal the present stage has a row that is drawn again four times a second; a finished stage leaves its
    row above.  Elsewhere, and in a terminal that cannot move its cursor, it prints lines only: at the start and the
    end of a stage, and between them the rarer, the longer the run lasts.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self._lines = EventLines()
        self._row: StageRow | None = None
        self._ended = ""
        """The name of the stage that has just finished, whose last event may repeat."""
        self._began = self._printed_at = self._left_at = time.monotonic()
        self._lock = threading.RLock()
        self._live: Live | None = None
        if console.is_terminal and not console.is_dumb_terminal:
            self._live = Live(console=console, get_renderable=self._draw, transient=True)

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with self._lock:
            self._print(self._lines.rest())
            self._leave()
        if self._live is not None:
            self._live.stop()

    def report(self, event: dict[str, Any]) -> None:
        """Show one event of the learner, the fleet or an evaluation."""
        now = time.monotonic()
        with self._lock:
            if event["event"] == "progress":
                self._print(self._lines.due(now))
                self._stage(event, now)
            else:
                self._print(self._lines.add(event, now))

    def _print(self, lines: list[str]) -> None:
        for line in lines:
            self.console.print(Text(f"{stamp()} {plain(line, _LONGEST)}"), soft_wrap=self._live is None)

    def _draw(self) -> Text:
        """The row of the present stage, for the terminal."""
        now = time.monotonic()
        with self._lock:
            if self._row is not None:
                ascii_only = self.console.options.ascii_only
                row = self._row.fit(self.console.width, now, ascii_only)
                return Text(plain(row, _LONGEST), no_wrap=True, overflow="crop")
            waited, what = now - self._left_at, "waits for the next stage" if self._ended else "starting"
        return Text(f"{what}, {duration(waited)}" if waited > 2.0 else "")

    def _stage(self, event: dict[str, Any], now: float) -> None:
        name = name_of(event)
        if self._row is None or self._row.name != name:
            if name == self._ended and event["step"] >= event["steps"]:
                return
            self._leave()
            self._row, self._ended = StageRow(event, now), ""
            if self._live is None and not self._row.finished:
                self._print_row(now)
        else:
            self._row.update(event, now)
        if self._row.finished:
            self._ended = name
            self._leave()
        elif self._live is None and now - self._printed_at >= self._period(now):
            self._print_row(now)

    def _period(self, now: float) -> float:
        return min(_MAX_PERIOD_S, max(_PERIOD_S, (now - self._began) / _LINES))

    def _print_row(self, now: float) -> None:
        assert self._row is not None
        self._printed_at = now
        self._print([self._row.line(now)])

    def _leave(self) -> None:
        """Print the last row of the present stage."""
        row, self._row = self._row, None
        if row is None:
            return
        now = self._left_at = time.monotonic()
        if self._live is None:
            self._print([row.line(now)])
        else:
            self.console.print(
                Text(plain(row.fit(self.console.width, now, self.console.options.ascii_only), _LONGEST), no_wrap=True)
            )


@contextlib.contextmanager
def reporting(progress: Show) -> Iterator[ReportEvent]:
    """The function that receives the events of some work, as a context around the work."""
    if callable(progress):
        yield progress
    elif progress:
        with Display(PlainConsole(soft_wrap=True)) as display:
            yield display.report
    else:
        yield lambda event: None
