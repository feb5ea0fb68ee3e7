"""What is opened over the terminal view: a variation, and what the keys do."""

from __future__ import annotations

from collections.abc import Iterator

from textual import screen
from textual.widget import Widget

from icrl_dist.monitor.lines import ACCENT, DIM, PLAIN, TITLE, Line, Scroll
from icrl_dist.monitor.panes import Header, Keys

KEYS = (
    ("q, Ctrl-C", "leave; the run goes on"),
    ("Tab, Shift-Tab, 1 to 4", "variations, workers, rates, events"),
    ("↑ ↓ PgUp PgDn Home End", "move (j and k too)"),
    ("Enter", "open a variation; [ and ] go to its neighbours"),
    ("s, S", "sort by the next column; the other way round"),
    ("/", "filter: task 3, task 3/1, dirichlet, quarantined, any words"),
    ("Esc", "all rows again; back"),
    ("p, Space", "freeze what is shown, the run goes on; in a recording, pause"),
    ("+ -", "a recording at twice or half the speed"),
    ("← →", "a twentieth of the recording back or on"),
)

HELP: list[Line] = [
    [(" KEYS", TITLE)],
    *([(f" {key:<24}", ACCENT), (does, PLAIN)] for key, does in KEYS),
    [],
    [(" The view reads the monitor plane only: it can slow nobody down, and what it misses is", DIM)],
    [(" missing here, never from the run.  docs/monitor.md says what everything means.", DIM)],
]


class Overlay(screen.Screen[None]):
    """Something read from top to bottom, over the view."""

    def compose(self) -> Iterator[Widget]:
        yield Header("header")
        yield Scroll("sheet")
        yield Keys("keys")

    def on_mount(self) -> None:
        self.query_one(Scroll).focus()


class Detail(Overlay):
    """One variation."""

    def __init__(self, variation: str) -> None:
        super().__init__()
        self.variation = variation
        self.filled = ""
        """The one whose figures are shown; while the view is frozen, as they were when it was first asked for."""


class Help(Overlay):
    """What the keys do."""
