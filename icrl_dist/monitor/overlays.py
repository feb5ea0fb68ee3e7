"""Screens that open over the terminal view: one variation, and the help."""

from __future__ import annotations

from collections.abc import Iterator

from textual import screen
from textual.widget import Widget

from icrl_dist.monitor.lines import ACCENT, DIM, PLAIN, TITLE, Line, Scroll
from icrl_dist.monitor.panes import Header, Keys

KEYS = (
    ("q, Ctrl-C", "quit the view; the run continues"),
    ("Tab, Shift-Tab, 1 to 4", "variations, workers, rates, events"),
    ("↑ ↓ PgUp PgDn Home End", "move (j and k too)"),
    ("Enter", "open a variation; [ and ] open the previous and the next one"),
    ("s, S", "sort by the next column; reverse the order"),
    ("/", "filter: task 3, task 3/1, dirichlet, quarantined, any words"),
    ("Esc", "remove the filter; back"),
    ("p, Space", "freeze the view, the run continues; in a recording, pause"),
    ("+ -", "double or halve the speed of a recording"),
    ("← →", "seek back or forward by a twentieth of the recording"),
)

HELP: list[Line] = [
    [(" KEYS", TITLE)],
    *([(f" {key:<24}", ACCENT), (does, PLAIN)] for key, does in KEYS),
    [],
    [(" The view only reads monitor messages: it cannot slow the run, and a message that is", DIM)],
    [(" lost on the way is missing here, never in the run.  See docs/monitor.md.", DIM)],
]


class Overlay(screen.Screen[None]):
    """A scrollable text over the view."""

    def compose(self) -> Iterator[Widget]:
        yield Header("header")
        yield Scroll("sheet")
        yield Keys("keys")

    def on_mount(self) -> None:
        self.query_one(Scroll).focus()


class Detail(Overlay):
    """The details of one variation."""

    def __init__(self, variation: str) -> None:
        super().__init__()
        self.variation = variation
        self.filled = ""
        """The variation whose text is shown now; while the view is frozen, the text is not updated."""


class Help(Overlay):
    """The list of keys."""
