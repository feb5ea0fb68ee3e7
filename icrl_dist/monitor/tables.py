"""The view's two tables, of workers and of variations: sorted, filtered, and only the rows in sight are made."""

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
class Kind:
    """What a table is of."""

    title: str
    columns: tuple[Column, ...]
    orders: dict[str, Callable[[Row], Any]]
    """Ways to sort, by name: of each, what is compared; the first is the default."""
    draw: Callable[[Row, str, int], Part]
    """A row's cell in the named column, so many cells wide."""
    across: Callable[[Row], str]
    """What to say of a row instead of its figures, if anything."""
    named: tuple[str, ...]
    """The columns that are no figures."""
    empty: str
    """What to say as long as there are none."""


class Table(Lines, can_focus=True):
    """A table with a cursor."""

    class Opened(Message):
        """A row was chosen; ``row`` is its name."""

        def __init__(self, row: str) -> None:
            super().__init__()
            self.row = row

    def __init__(self, name: str, kind: Kind) -> None:
        super().__init__(name)
        self._kind = kind
        self._rows: list[Row] = []
        self._total = self._top = self._cursor = 0
        self._at = ""
        self._order, self._reverse = next(iter(kind.orders)), False
        self.filter = ""
        """What rows must match, as it was typed."""
        self.note = ""
        """Added to the title."""
        self._all: list[Row] = []

    def fill(self, rows: Iterable[Row]) -> None:
        """Show these rows; the cursor stays on the row that it is on, wherever that goes."""
        self._all = list(rows)
        self._total = len(self._all)
        shown = [row for row in self._all if matches(row, self.filter)] if self.filter else self._all
        key = self._kind.orders[self._order]
        self._rows = sorted(shown, key=key, reverse=self._reverse)
        if self._at and self._cursor:  # on the first row it stays on the first row
            places = {row["name"]: index for index, row in enumerate(self._rows)}
            self._cursor = places.get(self._at, self._cursor)
        self._draw()

    def again(self) -> None:
        """Sort, filter and draw once more."""
        self.fill(self._all)

    def sort_next(self) -> None:
        """Sort by the next of the ways that there are."""
        names = list(self._kind.orders)
        self._order, self._reverse = names[(names.index(self._order) + 1) % len(names)], False
        self.again()

    def sort_reverse(self) -> None:
        """Sort the other way round."""
        self._reverse = not self._reverse
        self.again()

    def beside(self, step: int) -> str:
        """The name of the row so many further, which the cursor goes to."""
        self._move(self._cursor + step)
        return self._at

    def on_resize(self) -> None:
        self.again()

    def on_focus(self) -> None:
        self._draw()

    def on_blur(self) -> None:
        self._draw()

    def on_key(self, event: events.Key) -> None:
        page = max(1, self.size.height - _HEAD)
        steps = {"up": -1, "k": -1, "down": 1, "j": 1, "pageup": -page, "pagedown": page, "home": -(10**9), "end": 10**9}
        if event.key in steps:
            event.stop()
            self._move(self._cursor + steps[event.key])
        elif event.key == "enter" and self._rows:
            event.stop()
            self.post_message(self.Opened(self._rows[self._cursor]["name"]))

    def _move(self, to: int) -> None:
        self._cursor = min(max(0, to), max(0, len(self._rows) - 1))
        self._at = self._rows[self._cursor]["name"] if self._rows else ""
        self._draw()

    def _draw(self) -> None:
        width, room = self.size.width, max(0, self.size.height - _HEAD)
        if not width:
            return
        count = len(self._rows)
        self._cursor = min(self._cursor, max(0, count - 1))
        self._at = self._rows[self._cursor]["name"] if self._rows else ""
        self._top = max(0, min(max(min(self._top, self._cursor), self._cursor - room + 1), max(0, count - room)))
        fitted = fit(self._kind.columns, width)
        self.show([self._title(width, room), self._header(fitted), *self._body(fitted, width, room)])

    def _title(self, width: int, room: int) -> Line:
        arrow = "▲" if self._reverse else "▼"
        title: Line = [(self._kind.title, TITLE), (f" {self._total:,}", BOLD), (f"  by {self._order} {arrow}", DIM)]
        if self.filter:
            title += [("  only ", DIM), (f"{self.filter}: {len(self._rows):,}", WARNING)]
        if self.note:
            title.append((f"  {self.note}", WARNING))
        more = len(self._rows) - self._top - room
        where = f"{self._top + 1:,}-{min(len(self._rows), self._top + room):,} of {len(self._rows):,}"
        return spread(title, [(f"{where}, {more:,} more below" if more > 0 else where, DIM)] if self._rows else [], width)

    def _header(self, fitted: list[tuple[Column, int]]) -> Line:
        return [(cell(column.title, width, column.right) + " ", DIM) for column, width in fitted]

    def _body(self, fitted: list[tuple[Column, int]], width: int, room: int) -> list[Line]:
        if not self._rows:
            return [[("none matches; Esc shows all" if self._total else self._kind.empty, DIM)]]
        lines: list[Line] = []
        for index in range(self._top, min(len(self._rows), self._top + room)):
            row, line, used = self._rows[index], [], 0
            across = self._kind.across(row)
            for column, wide in fitted:
                if across and column.name not in self._kind.named:
                    line.append((cell(across, width - used), TROUBLE))
                    break
                text, style = self._kind.draw(row, column.name, wide)
                line.append((cell(text, wide, column.right) + " ", style))
                used += wide + 1
            if index == self._cursor and self.has_focus:
                line = [(text, style + CURSOR) for text, style in spread(line, [("", PLAIN)], width)]
            lines.append(line)
        return lines


_TROUBLE = ("gone", "silent", "waiting", "working", "done")


def worker_row(row: Row) -> Row:
    """A worker's row with what is searched."""
    parts = row["job"].split("/")
    found = " ".join((row["name"], row["state"], row["job"], row["doing"])).casefold()
    return row | {"found": found, "task": parts[2] if len(parts) > 2 else "", "variation": parts[3] if len(parts) > 3 else ""}


def _draw_worker(row: Row, column: str, width: int) -> Part:
    state = row["state"]
    style = TROUBLE if state in ("gone", "silent") else DIM if state in ("waiting", "done") else PLAIN
    if column == "state":
        told = f"{state} {row['silent_s']:.0f} s" if state in ("gone", "silent") else state
        return told, GOOD if state == "working" else style
    if column == "steps_per_s":
        return number(row["steps_per_s"], 0), style
    if column == "memory_mb":
        return (f"{row['memory_mb']:,.0f} MB" if row["memory_mb"] else "-"), style
    if column in ("unstored", "lag", "resent", "restarts"):
        return f"{row[column]:,}", WARNING if row[column] and column != "unstored" else style
    if column == "episodes":
        return f"{row['episodes']:,}", style
    return row[column] or "-", style


WORKERS = Kind(
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
        "trouble": lambda row: (_TROUBLE.index(row["state"]), -row["restarts"], row["name"]),
        "name": lambda row: row["name"],
        "episodes": lambda row: (-row["episodes"], row["name"]),
        "steps/s": lambda row: (-row["steps_per_s"], row["name"]),
        "unstored": lambda row: (-row["unstored"], row["name"]),
        "memory": lambda row: (-row["memory_mb"], row["name"]),
    },
    draw=_draw_worker,
    across=lambda row: "",
    named=(),
    empty="none has been heard of yet",
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
    if column == "played":
        return row["played"], style if row["quarantine"] else ACCENT
    return str(row[column]), style


def _share_style(share: float | None, style: Any) -> Any:
    return style if share is None else GOOD if share >= 0.9 else WARNING if share < 0.5 else PLAIN


def _place(row: Row) -> tuple[int, int]:
    return row["task"], row["variation"]


def _known(value: float | None) -> float:
    return float("inf") if value is None else value


VARIATIONS = Kind(
    title="VARIATIONS",
    columns=(
        Column("name", "task", 7),
        Column("where", "parameters", 14, rank=6, stretch=1),
        Column("played", "adversary", 13, rank=1, stretch=2),
        Column("phase", "phase", 10, rank=4),
        Column("episodes", "eps", 5, rank=5, right=True),
        Column("last", "last", 7, rank=2, right=True),
        Column("mean", "mean 5", 7, rank=1, right=True),
        Column("optimum", "optimum", 7, rank=3, right=True),
        Column("share", "share", 5, rank=1, right=True),
        Column("returns", "returns, by episode", 12, stretch=3),
    ),
    orders={
        "task": lambda row: (not row["quarantine"], _place(row)),
        "share": lambda row: (not row["quarantine"], _known(row["share"]), _place(row)),
        "mean": lambda row: (_known(row["mean"]), _place(row)),
        "last": lambda row: (_known(row["last"]), _place(row)),
        "adversary": lambda row: (row["played"], _place(row)),
        "episodes": lambda row: (-row["episodes"], _place(row)),
    },
    draw=_draw_variation,
    across=lambda row: f"QUARANTINED: {row['quarantine']}" if row["quarantine"] else "",
    named=("name", "where", "played"),
    empty="none has been heard of yet: a trajectory tells of its variation",
)
