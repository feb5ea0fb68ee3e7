"""What the terminal view has seen: a picture's changes put together, and rows made of them."""

from __future__ import annotations

from collections import deque
from typing import Any

from icrl_dist.monitor.rates import SERIES
from icrl_dist.monitor.run_state import RunState

_POINTS = 600
_EVENTS = 200
_LAST = 5
"""Returns that the mean is taken of."""

Row = dict[str, Any]


class ViewState:
    """A picture as of the last look; its rows are made anew only where something changed."""

    def __init__(self, picture: RunState) -> None:
        self._picture = picture
        self._forget("")

    def _forget(self, epoch: str) -> None:
        self._epoch, self._since = epoch, -1
        self.run: Row = {}
        self.workers: list[Row] = []
        self.alerts: list[Row] = []
        self.ignored: dict[str, int] = {}
        self.variations: dict[str, Row] = {}
        """By name, ``TASK/VARIATION``."""
        self.variation_count = self.left_out = 0
        self.series: dict[str, deque[float | None]] = {name: deque(maxlen=_POINTS) for name in SERIES}
        self.points = 0
        """The number of the newest point of each series; from 1 on."""
        self.events: deque[Row] = deque(maxlen=_EVENTS)
        """The oldest first."""
        self.time = 0.0

    def look(self, now: float) -> None:
        """Take in what has changed by then."""
        shot = self._picture.snapshot(now, self._since)
        if shot["epoch"] != self._epoch:
            self._forget(shot["epoch"])
            shot = self._picture.snapshot(now)
            self._epoch = shot["epoch"]
        self._since, self.time = shot["seq"], shot["time"]
        for name in ("run", "workers", "alerts", "ignored", "variation_count"):
            setattr(self, name, shot[name])
        self.left_out = shot["variations_left_out"]
        for variation in shot["variations"]:
            self.variations[variation["name"]] = summary(variation)
        numbers = shot["series"]["number"]
        new = sum(number > self.points for number in numbers)
        for name in SERIES:
            self.series[name].extend(shot["series"][name][len(numbers) - new :])
        self.points = numbers[-1] if new else self.points
        known = self.events[-1]["number"] if self.events else 0  # what comes between two ticks is told twice
        self.events.extend(event for event in shot["events"] if event["number"] > known)


def summary(variation: Row) -> Row:
    """A variation with what its newest returns come to: ``last``, ``mean``, ``share`` of the optimum; None if unknown.

    And ``found``, what a search looks at.
    """
    newest: Row = variation["phases"][-1] if variation["phases"] else {"name": "", "trials": [], "returns": []}
    returns, optimum = newest["returns"], variation["optimum"]
    tail = returns[-_LAST:]
    mean = sum(tail) / len(tail) if tail else None
    about = {
        "phase": newest["name"],
        "returns": returns,
        "episodes": newest["trials"][-1] + 1 if newest["trials"] else 0,
        "last": returns[-1] if returns else None,
        "mean": mean,
        "share": mean / optimum if mean is not None and optimum else None,
        "played": told(variation["adversary"], "kind"),
        "where": told({n: v for n, v in variation["parameters"].items() if n not in _COMMON}),
    }
    row = variation | about
    quarantine = f"quarantined {row['quarantine']}" if row["quarantine"] else ""
    found = " ".join((row["name"], row["phase"], row["played"], row["where"], quarantine))
    return row | {"found": found.casefold()}


_COMMON = ("size", "horizon")
"""Parameters that all tasks of a run have in common: not worth a column."""


def told(parameters: dict[str, Any], first: str = "") -> str:
    """Parameters on one line, the value of ``first`` before the others and without its name."""
    others = (f"{name} {value_text(value)}" for name, value in sorted(parameters.items()) if name != first)
    return " ".join([*([value_text(parameters[first])] if parameters.get(first) else []), *others])


def value_text(value: object) -> str:
    """A parameter's value, short."""
    if isinstance(value, list):
        return ",".join(value_text(one) for one in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def duration(seconds: float | None) -> str:
    """As 0:07, 3:21 or 1:02:03; a dash if it is not known."""
    if seconds is None:
        return "-"
    whole = int(seconds)
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def number(value: float | None, digits: int = 1) -> str:
    """Short: with thousands marked where it is large; a dash if it is not known."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}f}"


def matches(row: Row, wanted: str) -> bool:
    """Whether a row of a table is what was typed: ``task 3``, ``task 3/1``, or words that must all be in it."""
    words = wanted.casefold().split()
    while "task" in words[:-1]:
        at = words.index("task")
        place = words.pop(at + 1)
        words.pop(at)
        if place.replace("/", "").isdigit():
            task, _, variation = place.partition("/")
            if str(row["task"]) != task or (variation and str(row.get("variation")) != variation):
                return False
        else:
            words.append(place)
    return all(word in row["found"] for word in words)
