"""What the keys of the terminal view do."""

from __future__ import annotations

from icrl_dist.monitor.lines import ACCENT, DIM, PLAIN, TITLE, Line

KEYS = (
    ("q, Ctrl-C", "leave; the run goes on"),
    ("Tab, Shift-Tab, 1 to 4", "variations, workers, rates, events"),
    ("↑ ↓ PgUp PgDn Home End", "move (j and k too)"),
    ("Enter", "open a variation: its adversary, returns, path and lineage; [ and ] go to the next"),
    ("s, S", "sort by the next column; the other way round"),
    ("/", "filter: task 3, task 3/1, dirichlet, quarantined, or any words; Enter keeps it"),
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
