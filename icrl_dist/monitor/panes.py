"""Parts of the terminal view beside its tables: header, rates, events, keys and tabs."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Sequence
from itertools import islice
from typing import Any

from icrl_dist.monitor.lines import (
    ACCENT,
    BOLD,
    DIM,
    GOOD,
    PLAIN,
    SPARK,
    TITLE,
    TROUBLE,
    WARNING,
    Line,
    Lines,
    cell,
    flow,
    spread,
)
from icrl_dist.monitor.spark import bar, plot
from icrl_dist.monitor.view_state import ViewState, duration, number

_GOOD_STATES = ("collecting", "fitting", "evaluating", "finished")
_STATES = dict.fromkeys(_GOOD_STATES, GOOD) | {"waiting": WARNING, "interrupted": WARNING}
"""Styles of the normal states; any other state is styled as trouble."""
_MAX_ALERTS = 4
"""Alerts shown in full; further ones are counted."""
_MAX_HEIGHT = 4
"""Limit on the lines of a sparkline."""
_SPAN = 300
"""Points, one a second, in a sparkline."""


class Header(Lines):
    """The run, its stage, the position in a recording, and the active alerts."""

    def fill(self, view: ViewState, replay: dict[str, Any] | None, frozen: float | None, brief: bool) -> None:
        """Show ``view``; ``frozen``: when the view was frozen (Unix seconds), if it is; ``brief``: with a line of rates."""
        width = max(20, self.size.width)
        top: list[Line] = [[(f" {part}", BOLD)] for part in textwrap.wrap(view.headline, width - 1)]
        lines = [_run(view), *top, _stage(view, width), *([_brief(view)] if brief else [])]
        lines += [*_training(view, width), *_held_out(view, width, 1 if brief else _MAX_LEVELS)]
        if replay is not None:
            lines.append(_replay(replay, width))
        if frozen is not None:
            lines.append([(f" FROZEN at {_clock(frozen)}: the run continues; p unfreezes the view", WARNING)])
        lines += [[(f" ALERT {alert['text']}", TROUBLE)] for alert in view.alerts[:_MAX_ALERTS]]
        if len(view.alerts) > _MAX_ALERTS:
            lines.append([(f" and {len(view.alerts) - _MAX_ALERTS} more alerts", TROUBLE)])
        if self.styles.height is None or self.styles.height.value != len(lines):
            self.styles.height = len(lines)
        self.show(lines)


def _run(view: ViewState) -> Line:
    run = view.run
    state = run.get("state", "waiting")
    silent = f"SILENT for {run.get('silent_s') or 0:.0f} s"
    state_text = {"waiting": "waiting for the learner", "silent": silent}.get(state, state)
    kind = " · ".join(run[name] for name in ("method", "problem") if run.get(name))
    alerts = f", {len(view.alerts)} alert{'s' if len(view.alerts) > 1 else ''}" if view.alerts else ""
    left: Line = [
        (f" {cell(run['name'], min(len(run['name']), 32)) if run.get('name') else 'no run yet'} ", BOLD),
        (f" {kind}  " if kind else " ", DIM),
        (f"● {state_text}{alerts}", TROUBLE if alerts else _STATES.get(state, TROUBLE)),
    ]
    if run.get("version", -1) >= 0:
        left.append((f"  T^{run['version']}", ACCENT))
    left.append((f"  {run.get('trajectories', 0):,} stored", PLAIN))
    return left


def _stage(view: ViewState, width: int) -> Line:
    run = view.run
    if not run.get("steps"):
        return [(" no stage has started", DIM)]
    elapsed = f"elapsed {duration(run.get('elapsed_s'))}, left {duration(run.get('eta_s'))} "
    name = run["stage_text"]
    share = run["step"] / run["steps"]
    left = f", {duration(run['stage_eta_s'])} left" if run.get("stage_eta_s") else ""
    steps = f" {share:4.0%}  {run['step']:,} of {run['steps']:,}{left}"
    done, rest = bar(share, max(5, min(60, width - len(name) - len(steps) - len(elapsed) - 4)))
    return spread([(f" {name} ", PLAIN), (done, GOOD), (rest, DIM), (steps, PLAIN)], [(elapsed, DIM)], width)


_PAST = {"loading": "  earlier episodes are being loaded", "missing": "  episodes before this view are missing"}
_MAX_LEVELS = 3
"""Strengths p whose held-out returns are shown, the largest."""


def _training(view: ViewState, width: int) -> list[Line]:
    """Mean training return of each phase, over the last five episodes, with the number of variations in the mean."""
    if not view.averages:
        return []
    groups: list[Line] = []
    for one in view.averages[-3:]:
        of = f", {one['pending']} optima to compute" if one["pending"] else " of the optimum" if one["scaled"] else ""
        groups.append(
            [
                (f"  {one['name']} ", DIM),
                ("-" if one["last"] is None else f"{one['last']:.2f}", PLAIN),
                (f"{of}, n {one['variations']} of {one['of']}", DIM),
            ]
        )
    return flow([(" training returns", DIM)], [*groups, [(_PAST.get(view.past, ""), WARNING)]], width)


def _held_out(view: ViewState, width: int, most: int) -> list[Line]:
    """Held-out returns of every agent, with 95% intervals: shares of the ceiling where there is one, by p."""
    levels = sorted(view.evaluation["levels"], key=lambda level: float(level["p"]))[-most:] if view.evaluation else []
    lines: list[Line] = []
    for level in levels:
        groups: list[Line] = []
        for agent in level["agents"]:
            value, low, high = (agent["share"] if level["ceiling"] else None) or agent["value"]
            interval = "" if low is None else f" [{low:.2f}, {high:.2f}]"
            style = BOLD if agent["role"] == "newest" else PLAIN
            groups.append([(f"  {agent['name']} ", DIM), (number(value, 2), style), (interval, DIM)])
        of = f" of {level['ceiling']}" if level["ceiling"] else ""
        lines += flow([(f" held-out{of}, p {level['p']:g}", DIM)], groups, width)
    return lines


def _brief(view: ViewState) -> Line:
    newest = {name: next((v for v in reversed(view.series[name]) if v is not None), None) for name, _, _ in _RATES}
    short = (("stored/s", "stored_per_s", 0), ("steps/s", "steps_per_s", 0), ("fit/s", "fit_per_s", 1), ("loss", "loss", 3))
    line: Line = []
    for label, name, digits in (*short, ("lag", "lag", 0), ("unstored", "unstored", 0)):
        line += [(f" {label} ", DIM), (number(newest[name], digits) + " ", PLAIN)]
    dropped = sum((view.run.get("drops") or {}).values())
    return [*line, (" dropped ", DIM), (f"{dropped:,}", WARNING if dropped else PLAIN)]


def _replay(replay: dict[str, Any], width: int) -> Line:
    at, length = replay["at"] - replay["begin"], replay["end"] - replay["begin"]
    mode = "PAUSED" if replay["paused"] else "at its end" if at >= length else f"at {replay['speed']:g}x"
    name = f" {'⏸' if replay['paused'] else '▶'} recording {mode} "
    position = f" {duration(at)} of {duration(length)}, {_clock(replay['at'])}"
    done, rest = bar(at / length if length > 0 else 1.0, max(5, min(60, width - len(name) - len(position) - 2)))
    return [(name, WARNING if replay["paused"] else ACCENT), (done, ACCENT), (rest, DIM), (position, PLAIN)]


def _clock(unix_s: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(unix_s))


_RATES = (
    ("stored_per_s", "stored/s", 1),
    ("episodes_per_s", "episodes/s", 1),
    ("steps_per_s", "env steps/s", 0),
    ("unstored", "unstored", 0),
    ("lag", "weights lag", 0),
    ("fit_per_s", "fit steps/s", 1),
    ("loss", "loss", 4),
)


def rate_lines(view: ViewState, width: int, height: int, focused: bool) -> tuple[list[Line], list[Line]]:
    """Title and lines of the rates pane: a sparkline for each rate, then counts of dropped and ignored messages."""
    room = max(8, width - 23)
    head: list[Line] = [[("RATES", title(focused)), (f"  the last {_SPAN // 60} minutes", DIM)]]
    lines: list[Line] = []
    each = -(-_SPAN // room)
    counted = [*_counted("dropped", view.run.get("drops") or {}), *_counted("ignored", view.ignored)]
    tall = min(_MAX_HEIGHT, max(1, (height - 1 - len(counted)) // len(_RATES)))
    for name, label, digits in _RATES:
        series = view.series[name]
        kept = min(len(series), room * each)
        begin = len(series) - kept
        begin += -(view.points - kept) % each  # so that a point stays in its bucket when points are added
        values = list(islice(series, begin, None))
        buckets = [_mean(values[i : i + each]) for i in range(0, len(values), each)][-room:]
        known = [value for value in buckets if value is not None]
        low = min(known, default=0.0) if name == "loss" else 0.0
        newest = next((value for value in reversed(series) if value is not None), None)
        line: Line = [(cell(label, 12), DIM), (cell(number(newest, digits), 9, right=True) + "  ", BOLD)]
        drawn = plot(buckets, room, tall, low, max([*known, low + 1e-9]))
        lines += [[(" " * 23, PLAIN), (above, SPARK)] for above in drawn[:-1]]
        lines.append([*line, (drawn[-1], SPARK)])
    return head, [*lines, *counted]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _counted(what: str, counts: dict[str, int]) -> list[Line]:
    if not counts:
        return [[(cell(what, 12), DIM), (cell("none", 9, right=True), PLAIN)]]
    common = sorted(counts.items(), key=lambda one: (-one[1], one[0]))
    return [
        [(cell(what if not i else "", 12), DIM), (cell(f"{n:,}", 9, right=True), WARNING), (f"  {why}", PLAIN)]
        for i, (why, n) in enumerate(common)
    ]


_WHAT = {"alert": TROUBLE, "crash": TROUBLE, "failed": TROUBLE, "quarantine": TROUBLE, "version": GOOD, "finished": GOOD}


def event_lines(view: ViewState, width: int, height: int, focused: bool) -> tuple[list[Line], list[Line]]:
    """Title and lines of the events pane, newest event last."""
    head: list[Line] = [[("EVENTS", title(focused)), (f" {len(view.events)}", BOLD), ("  newest last", DIM)]]
    lines: list[Line] = []
    for event in view.events:
        style = _WHAT.get(event["what"], PLAIN)
        for i, part in enumerate(textwrap.wrap(event["text"], max(10, width - 21)) or [""]):
            start: Line = [(f"{_clock(event['time'])} ", DIM), (cell(event["what"], 11) + " ", style)]
            lines.append([*(start if i == 0 else [(" " * 21, PLAIN)]), (part, style if style is TROUBLE else PLAIN)])
    return head, lines or [[("no events yet", DIM)]]


def title(focused: bool) -> Any:
    """The style of a pane's title."""
    return TITLE + FOCUSED if focused else TITLE


FOCUSED = BOLD.__class__(reverse=True)


class Keys(Lines):
    """One line of keys and their actions."""

    def fill(self, keys: Sequence[tuple[str, str]]) -> None:
        """Show ``keys``: pairs of key and action."""
        self.show([[part for key, does in keys for part in ((f" {key}", ACCENT), (f" {does} ", DIM))]])


class Tabs(Lines):
    """The numbered panes, for a terminal that fits only one."""

    def fill(self, names: Sequence[str], active: int) -> None:
        """Show the names; ``active``: index of the pane that is shown."""
        line: Line = [(" ", PLAIN)]
        for i, name in enumerate(names):
            line += [(f" {i + 1} {name} ", title(True) if i == active else DIM), (" ", PLAIN)]
        self.show([line])
