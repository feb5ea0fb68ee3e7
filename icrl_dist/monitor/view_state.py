"""State of the terminal view: accumulated snapshots of a run, and table rows made from them."""

from __future__ import annotations

from collections import deque
from typing import Any

from icrl_dist.monitor.rates import SERIES
from icrl_dist.monitor.run_state import RunState

_MAX_POINTS = 600
_MAX_EVENTS = 200
_RECENT = 5
"""Number of the newest returns in the mean."""

Row = dict[str, Any]


class ViewState:
    """Newest known state of a run; only the rows of what has changed are made anew."""

    def __init__(self, state: RunState) -> None:
        self._state = state
        self._clear("")

    def _clear(self, epoch: str) -> None:
        self._epoch, self._since = epoch, -1
        self.run: Row = {}
        self.workers: list[Row] = []
        self.alerts: list[Row] = []
        self.ignored: dict[str, int] = {}
        self.variations: dict[str, Row] = {}
        """By name, ``TASK/VARIATION``."""
        self.variation_count = self.left_out = 0
        self.series: dict[str, deque[float | None]] = {name: deque(maxlen=_MAX_POINTS) for name in SERIES}
        self.points = 0
        """Number of the newest point of each series; the first has number 1."""
        self.events: deque[Row] = deque(maxlen=_MAX_EVENTS)
        """Oldest first."""
        self.time = 0.0
        self.headline = ""
        self.averages: list[Row] = []
        """Mean training return of each phase, oldest first."""
        self.past = ""
        self.evaluation: Row | None = None
        """Held-out returns."""

    def update(self, now: float) -> None:
        """Take in what has changed until ``now``."""
        snapshot = self._state.snapshot(now, self._since)
        if snapshot["epoch"] != self._epoch:
            self._clear(snapshot["epoch"])
            snapshot = self._state.snapshot(now)
            self._epoch = snapshot["epoch"]
        self._since, self.time = snapshot["seq"], snapshot["time"]
        for name in ("run", "workers", "alerts", "ignored", "variation_count", "headline", "averages", "past"):
            setattr(self, name, snapshot[name])
        self.left_out = snapshot["variations_left_out"]
        self.evaluation = snapshot["evaluation"] or self.evaluation
        for variation in snapshot["variations"]:
            self.variations[variation["name"]] = summary(variation)
        numbers = snapshot["series"]["number"]
        new = sum(number > self.points for number in numbers)
        for name in SERIES:
            self.series[name].extend(snapshot["series"][name][len(numbers) - new :])
        self.points = numbers[-1] if new else self.points
        newest = self.events[-1]["number"] if self.events else 0  # an event between two ticks is in two snapshots
        self.events.extend(event for event in snapshot["events"] if event["number"] > newest)


def summary(variation: Row) -> Row:
    """The row of a variation: its fields and ``last``, ``mean`` and ``share`` of the optimum (None if unknown).

    ``search_text`` is what a filter is compared with.
    """
    newest: Row = variation["phases"][-1] if variation["phases"] else {"name": "", "trials": [], "returns": []}
    returns, optimum = newest["returns"], variation["optimum"]
    recent = returns[-_RECENT:]
    mean = sum(recent) / len(recent) if recent else None
    derived = {
        "phase": newest["name"],
        "returns": by_episode(newest["trials"], returns),
        "episodes": newest["trials"][-1] + 1 if newest["trials"] else 0,
        "last": returns[-1] if returns else None,
        "mean": mean,
        "share": mean / optimum if mean is not None and optimum else None,
        "adversary_text": parameters_text(variation["adversary"], "kind"),
        "parameters_text": parameters_text({n: v for n, v in variation["parameters"].items() if n not in _COMMON}),
    }
    row = variation | derived
    quarantine = f"quarantined {row['quarantine']}" if row["quarantine"] else ""
    search_text = " ".join((row["name"], row["phase"], row["adversary_text"], row["parameters_text"], quarantine))
    return row | {"search_text": search_text.casefold()}


def by_episode(trials: list[int], returns: list[float]) -> list[float | None]:
    """Returns in order of trial, with one None where trials are missing, however many these are."""
    found: list[float | None] = []
    for before, trial, value in zip([None, *trials], trials, returns, strict=False):
        found += [value] if before is None or trial == before + 1 else [None, value]
    return found


_COMMON = ("size", "horizon")
"""Parameters that are equal for all tasks of a run, and therefore not shown in the table."""


def parameters_text(parameters: dict[str, Any], first: str = "") -> str:
    """Parameters on one line; the value of ``first`` comes first, without its name."""
    others = (f"{name} {value_text(value)}" for name, value in sorted(parameters.items()) if name != first)
    return " ".join([*([value_text(parameters[first])] if parameters.get(first) else []), *others])


def value_text(value: object) -> str:
    """A short text of a parameter's value."""
    if isinstance(value, list):
        return ",".join(value_text(one) for one in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def duration(seconds: float | None) -> str:
    """A duration as 0:07, 3:21 or 1:02:03; a dash if it is unknown."""
    if seconds is None:
        return "-"
    whole = int(seconds)
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def number(value: float | None, digits: int = 1) -> str:
    """A short text of a number: from 1,000 on without decimals and with separators; a dash if it is unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}f}"


def matches(row: Row, query: str) -> bool:
    """Whether a table row matches a filter: ``task 3``, ``task 3/1``, or words that must all be in its text."""
    words = query.casefold().split()
    while "task" in words[:-1]:
        index = words.index("task")
        name = words.pop(index + 1)
        words.pop(index)
        if name.replace("/", "").isdigit():
            task, _, variation = name.partition("/")
            if str(row["task"]) != task or (variation and str(row.get("variation")) != variation):
                return False
        else:
            words.append(name)
    return all(word in row["search_text"] for word in words)
