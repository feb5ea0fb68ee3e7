"""The tables of workers and of variations: sorted, filtered; only the visible rows are drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from textual import events
from textual.message import Message

from icrl_dist.monitor.lines import (
    ACCENT,
    BOLD,
    CURSOR,
    DIM,
    GOOD,
    PLAIN,
    SPARK,
    TITLE,
    TROUBLE,
    WARNING,
    Column,
    Line,
    Lines,
    Part,
    cell,
    fit,
    spread,
)
from icrl_dist.monitor.spark import bounds, spark
from icrl_dist.monitor.view_state import Row, matches, number

_HEAD = 2
"""Lines above the rows."""


@dataclass(frozen=True)
class TableSpec:
    """Definition of a table: its columns, sort orders and texts."""

    title: str
    columns: tuple[Column, ...]
    orders: dict[str, Callable[[Row], Any]]
    """Sort keys by name of the order; the first order is the default."""
    draw: Callable[[Row, str, int], Part]
    """Text and style of a row's cell, given row, column name and width in cells."""
    notice: Callable[[Row], str]
    """A text that replaces a row's figures, or an empty text."""
    text_columns: tuple[str, ...]
    """The columns that a notice does not replace."""
    empty: str
    """Text of an empty table."""


class Table(Lines, can_focus=True):
    """A table with a cursor."""

    class Opened(Message):
        """The user opened a row; ``row`` is its name."""

        def __init__(self, row: str) -> None:
            super().__init__()
            self.row = row

    def __init__(self, name: str, spec: TableSpec) -> None:
        super().__init__(name)
        self._spec = spec
        self._rows: list[Row] = []
        self._total = self._top = self._cursor = 0
        self._selected = ""
        """Name of the row at the cursor."""
        self._order, self._reverse = next(iter(spec.orders)), False
        self.filter = ""
        """The filter as typed; only rows that match it are shown."""
        self.note = ""
        """Added to the title."""
        self._all: list[Row] = []

    def fill(self, rows: Iterable[Row]) -> None:
        """Replace the rows; the cursor stays on its row, wherever sorting moves that row."""
        self._all = list(rows)
        self._total = len(self._all)
        shown = [row for row in self._all if matches(row, self.filter)] if self.filter else self._all
        key = self._spec.orders[self._order]
        self._rows = sorted(shown, key=key, reverse=self._reverse)
        if self._selected and self._cursor:  # a cursor at the top stays at the top
            indices = {row["name"]: index for index, row in enumerate(self._rows)}
            self._cursor = indices.get(self._selected, self._cursor)
        self._draw()

    def redraw(self) -> None:
        """Sort, filter and draw the present rows again."""
        self.fill(self._all)

    def sort_next(self) -> None:
        """Switch to the next sort order."""
        names = list(self._spec.orders)
        self._order, self._reverse = names[(names.index(self._order) + 1) % len(names)], False
        self.redraw()

    def sort_reverse(self) -> None:
        """Reverse the sort order."""
        self._reverse = not self._reverse
        self.redraw()

    def move(self, step: int) -> str:
        """Move the cursor by ``step`` rows; returns the name of its row."""
        self._move_to(self._cursor + step)
        return self._selected

    def on_resize(self) -> None:
        self.redraw()

    def on_focus(self) -> None:
        self._draw()

    def on_blur(self) -> None:
        self._draw()

    def on_key(self, event: events.Key) -> None:
        page = max(1, self.size.height - _HEAD)
        steps = {"up": -1, "k": -1, "down": 1, "j": 1, "pageup": -page, "pagedown": page, "home": -(10**9), "end": 10**9}
        if event.key in steps:
            event.stop()
            self._move_to(self._cursor + steps[event.key])
        elif event.key == "enter" and self._rows:
            event.stop()
            self.post_message(self.Opened(self._rows[self._cursor]["name"]))

    def _move_to(self, index: int) -> None:
        self._cursor = min(max(0, index), max(0, len(self._rows) - 1))
        self._selected = self._rows[self._cursor]["name"] if self._rows else ""
        self._draw()

    def _draw(self) -> None:
        width, height = self.size.width, max(0, self.size.height - _HEAD)
        if not width:
            return
        count = len(self._rows)
        self._cursor = min(self._cursor, max(0, count - 1))
        self._selected = self._rows[self._cursor]["name"] if self._rows else ""
        self._top = max(0, min(max(min(self._top, self._cursor), self._cursor - height + 1), max(0, count - height)))
        fitted = fit(self._spec.columns, width)
        self.show([self._title(width, height), self._header(fitted), *self._body(fitted, width, height)])

    def _title(self, width: int, height: int) -> Line:
        arrow = "▲" if self._reverse else "▼"
        title: Line = [(self._spec.title, TITLE), (f" {self._total:,}", BOLD), (f"  by {self._order} {arrow}", DIM)]
        if self.filter:
            title += [("  only ", DIM), (f"{self.filter}: {len(self._rows):,}", WARNING)]
        if self.note:
            title.append((f"  {self.note}", WARNING))
        more = len(self._rows) - self._top - height
        shown = f"{self._top + 1:,}-{min(len(self._rows), self._top + height):,} of {len(self._rows):,}"
        return spread(title, [(f"{shown}, {more:,} more below" if more > 0 else shown, DIM)] if self._rows else [], width)

    def _header(self, fitted: list[tuple[Column, int]]) -> Line:
        return [(cell(column.title, width, column.right) + " ", DIM) for column, width in fitted]

    def _body(self, fitted: list[tuple[Column, int]], width: int, height: int) -> list[Line]:
        if not self._rows:
            return [[("no row matches; Esc shows all rows" if self._total else self._spec.empty, DIM)]]
        lines: list[Line] = []
        for index in range(self._top, min(len(self._rows), self._top + height)):
            row, line, used = self._rows[index], [], 0
            notice = self._spec.notice(row)
            for column, cells in fitted:
                if notice and column.name not in self._spec.text_columns:
                    line.append((cell(notice, width - used), TROUBLE))
                    break
                text, style = self._spec.draw(row, column.name, cells)
                line.append((cell(text, cells, column.right) + " ", style))
                used += cells + 1
            if index == self._cursor and self.has_focus:
                line = [(text, style + CURSOR) for text, style in spread(line, [("", PLAIN)], width)]
            lines.append(line)
        return lines


_STATES = ("gone", "silent", "waiting", "working", "done")
"""States of a worker, in the order of the table."""


def worker_row(row: Row) -> Row:
    """A worker's row, with ``search_text``, ``task`` and ``variation`` for filters."""
    parts = row["job"].split("/")
    search_text = " ".join((row["name"], row["state"], row["job"], row["doing"])).casefold()
    task, variation = (parts[2] if len(parts) > 2 else ""), (parts[3] if len(parts) > 3 else "")
    return row | {"search_text": search_text, "task": task, "variation": variation}


def _draw_worker(row: Row, column: str, width: int) -> Part:
    state = row["state"]
    style = TROUBLE if state in ("gone", "silent") else DIM if state in ("waiting", "done") else PLAIN
    if column == "state":
        text = f"{state} {row['silent_s']:.0f} s" if state in ("gone", "silent") else state
        return text, GOOD if state == "working" else style
    if column == "steps_per_s":
        return number(row["steps_per_s"], 0), style
    if column == "memory_mb":
        return (f"{row['memory_mb']:,.0f} MB" if row["memory_mb"] else "-"), style
    if column in ("unstored", "lag", "resent", "restarts"):
        return f"{row[column]:,}", WARNING if row[column] and column != "unstored" else style
    if column == "episodes":
        return f"{row['episodes']:,}", style
    return row[column] or "-", style


WORKERS = TableSpec(
    title="WORKERS",
    columns=(
        Column("state", "state", 11),
        Column("name", "worker", 12, stretch=1),
        Column("job", "job", 11, rank=1),
        Column("doing", "doing", 10, rank=8, stretch=3),
        Column("episodes", "episodes", 9, rank=2, right=True),
        Column("steps_per_s", "steps/s", 8, right=True),
        Column("unstored", "unstored", 8, rank=3, right=True),
        Column("lag", "lag", 4, rank=5, right=True),
        Column("resent", "resent", 6, rank=6, right=True),
        Column("restarts", "restarts", 8, rank=4, right=True),
        Column("memory_mb", "memory", 8, rank=7, right=True),
    ),
    orders={
        "trouble": lambda row: (_STATES.index(row["state"]), -row["restarts"], row["name"]),
        "name": lambda row: row["name"],
        "episodes": lambda row: (-row["episodes"], row["name"]),
        "steps/s": lambda row: (-row["steps_per_s"], row["name"]),
        "unstored": lambda row: (-row["unstored"], row["name"]),
        "memory": lambda row: (-row["memory_mb"], row["name"]),
    },
    draw=_draw_worker,
    notice=lambda row: "",
    text_columns=(),
    empty="no worker yet",
)


def _draw_variation(row: Row, column: str, width: int) -> Part:
    style = TROUBLE if row["quarantine"] else PLAIN
    if column == "returns":
        low, high = bounds(row["returns"], row["optimum"])
        return spark(row["returns"], width, low, high), SPARK
    if column == "share":
        return ("-" if row["share"] is None else f"{row['share']:.0%}"), _share_style(row["share"], style)
    if column in ("last", "mean", "optimum"):
        return number(row[column]), DIM if column == "optimum" else style
    if column == "episodes":
        return f"{row['episodes']:,}", style
    if column == "adversary_text":
        return row["adversary_text"], style if row["quarantine"] else ACCENT
    return str(row[column]), style


def _share_style(share: float | None, style: Any) -> Any:
    return style if share is None else GOOD if share >= 0.9 else WARNING if share < 0.5 else PLAIN


def _key(row: Row) -> tuple[int, int]:
    return row["task"], row["variation"]


def _unknown_last(value: float | None) -> float:
    return float("inf") if value is None else value


VARIATIONS = TableSpec(
    title="VARIATIONS",
    columns=(
        Column("name", "task", 7),
        Column("parameters_text", "parameters", 14, rank=6, stretch=1),
        Column("adversary_text", "adversary", 13, rank=1, stretch=2),
        Column("phase", "phase", 10, rank=4),
        Column("episodes", "eps", 5, rank=5, right=True),
        Column("last", "last", 7, rank=2, right=True),
        Column("mean", "mean 5", 7, rank=1, right=True),
        Column("optimum", "optimum", 7, rank=3, right=True),
        Column("share", "share", 5, rank=1, right=True),
        Column("returns", "returns, by episode", 12, stretch=3),
    ),
    orders={
        "task": lambda row: (not row["quarantine"], _key(row)),
        "share": lambda row: (not row["quarantine"], _unknown_last(row["share"]), _key(row)),
        "mean": lambda row: (_unknown_last(row["mean"]), _key(row)),
        "last": lambda row: (_unknown_last(row["last"]), _key(row)),
        "adversary": lambda row: (row["adversary_text"], _key(row)),
        "episodes": lambda row: (-row["episodes"], _key(row)),
    },
    draw=_draw_variation,
    notice=lambda row: f"QUARANTINED: {row['quarantine']}" if row["quarantine"] else "",
    text_columns=("name", "parameters_text", "adversary_text"),
    empty="no episode yet: a variation is listed after its first episode",
)
