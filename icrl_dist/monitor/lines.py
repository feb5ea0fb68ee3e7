"""Textual widgets made of lines of text; a line that has not changed is not sent to the terminal again.

Text from a run is never parsed as markup, and characters that take no cell or move the cursor are
removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.cells import cell_len, set_cell_size
from rich.segment import Segment
from rich.style import Style
from textual import events
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from icrl_dist.stream.excerpts import plain

PLAIN = Style.null()
BOLD = Style(bold=True)
DIM = Style(color="#8b93a7")
GOOD = Style(color="#7bd88f")
TROUBLE = Style(color="#ff6b6b", bold=True)
WARNING = Style(color="#f5c451")
ACCENT = Style(color="#7fb4ff")
SPARK = Style(color="#5fd7d7")
TITLE = Style(color="#7fb4ff", bold=True)
CURSOR = Style(bgcolor="#2c3f5f")

Part = tuple[str, Style]
Line = list[Part]
"""Pieces of text, each in one style."""


def safe(text: str) -> str:
    """``text`` as printable text without the characters that take no cell."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c for c in plain(text, len(text)) if cell_len(c) > 0)


def width_of(line: Line) -> int:
    """Width of a line in cells."""
    return sum(cell_len(text) for text, _ in line)


def spread(left: Line, right: Line, width: int) -> Line:
    """One line with a part at each end; the right part is left out where both do not fit."""
    gap = width - width_of(left) - width_of(right)
    return [*left, (" " * gap, PLAIN), *right] if gap > 0 else left


def flow(head: Line, groups: Sequence[Line], width: int) -> list[Line]:
    """``head`` and groups of parts on lines of at most ``width`` cells; a group is not divided."""
    lines = [list(head)]
    for group in groups:
        if width_of(lines[-1]) + width_of(group) > width:
            lines.append([])
        lines[-1] += group
    return lines


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str
    title: str
    width: int
    """Cells; the minimum for a column that stretches."""
    rank: int = 0
    """If the columns do not fit, those with the highest rank are removed first."""
    right: bool = False
    """Aligned to the right."""
    stretch: int = 0
    """Weight with which it receives remaining cells."""


def fit(columns: Sequence[Column], width: int) -> list[tuple[Column, int]]:
    """The columns that fit into ``width``, in order, each with its width; one cell lies between them."""
    kept = list(columns)
    while len(kept) > 1 and sum(column.width + 1 for column in kept) > width:
        kept.remove(max(reversed(kept), key=lambda column: column.rank))
    left = max(0, width - sum(column.width + 1 for column in kept))
    shares = sum(column.stretch for column in kept)
    widths = [column.width + (left * column.stretch // shares if shares else 0) for column in kept]
    return list(zip(kept, widths, strict=True))


def cell(text: str, width: int, right: bool = False) -> str:
    """``text`` in exactly ``width`` cells; text that is cut ends in an ellipsis."""
    text = safe(text)
    length = cell_len(text)
    if length > width:
        return set_cell_size(text, width - 1) + "…" if width > 1 else set_cell_size(text, width)
    return " " * (width - length) + text if right else text + " " * (width - length)


class Lines(Widget):
    """A widget that shows as many lines as fit; only changed lines are drawn again."""

    def __init__(self, name: str) -> None:
        super().__init__(id=name)
        self._lines: list[Line] = []

    @property
    def lines(self) -> list[str]:
        """The text that is shown, for tests."""
        return ["".join(text for text, _ in line) for line in self._lines]

    def show(self, lines: Sequence[Line]) -> None:
        """Replace the lines."""
        old, self._lines = self._lines, [[(safe(text), style) for text, style in line] for line in lines]
        longest = max(len(old), len(self._lines))
        changed = [y for y in range(min(longest, self.size.height)) if old[y : y + 1] != self._lines[y : y + 1]]
        if changed:
            self.refresh(*(Region(0, y, self.size.width, 1) for y in changed))

    def render_line(self, y: int) -> Strip:
        base, width = self.rich_style, self.size.width
        if y >= len(self._lines):
            return Strip.blank(width, base)
        strip = Strip([Segment(text, base + style) for text, style in self._lines[y]])
        if strip.cell_length > width > 0 and strip.text[width:].strip():
            strip = Strip([*strip.crop(0, width - 1), Segment("…", base + DIM)])
        return strip.adjust_cell_length(width, base)


class Scroll(Lines, can_focus=True):
    """A widget with more lines than fit, scrolled with the cursor keys."""

    def __init__(self, name: str, follow: bool = False) -> None:
        """``follow``: stay at the end when lines are added, until the user scrolls up."""
        super().__init__(name)
        self._content: list[Line] = []
        self._head: list[Line] = []
        self._follow, self._at_end, self._top = follow, follow, 0

    def fill(self, head: list[Line], lines: list[Line]) -> None:
        """Replace the content; ``head`` does not scroll."""
        self._head, self._content = head, lines
        self._draw()

    def _draw(self) -> None:
        last = max(0, len(self._content) - self._page_size())
        self._top = last if self._at_end else min(self._top, last)
        self.show([*self._head, *self._content[self._top : self._top + self._page_size()]])

    def _page_size(self) -> int:
        return max(1, self.size.height - len(self._head))

    def on_resize(self) -> None:
        self._draw()

    def on_key(self, event: events.Key) -> None:
        page = self._page_size()
        steps = {"up": -1, "k": -1, "down": 1, "j": 1, "pageup": -page, "pagedown": page, "home": -(10**9), "end": 10**9}
        if event.key in steps:
            event.stop()
            last = max(0, len(self._content) - page)
            self._top = min(max(0, self._top + steps[event.key]), last)
            self._at_end = self._follow and self._top == last
            self._draw()
