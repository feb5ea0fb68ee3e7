"""The text of one variation in the terminal view: parameters, returns, newest episode, lineage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from icrl_dist.monitor.lines import ACCENT, BOLD, DIM, GOOD, PLAIN, SPARK, TITLE, TROUBLE, WARNING, Line, cell
from icrl_dist.monitor.spark import bounds, plot, room
from icrl_dist.monitor.view_state import by_episode, number, parameters_text, summary

_HEIGHT = 6
"""Lines of a plot."""
_MAX_ROOM = 24
"""Cells along a side; the path in a larger room is not drawn."""
_MARKS = {"goal": GOOD + BOLD, "start": ACCENT + BOLD, "moved": TROUBLE, "path": PLAIN, "empty": DIM}


def lines(variation: dict[str, Any], width: int) -> tuple[list[Line], list[Line]]:
    """Heading and body; ``variation`` is a result of ``RunState.variation``."""
    row = summary(variation)
    head: list[Line] = [[(f" VARIATION {row['name']}", TITLE), (f"  {row['problem']}  {row['adversary_text']}", BOLD)]]
    body: list[Line] = [
        _field("parameters", parameters_text(row["parameters"])),
        _field("adversary", parameters_text(row["adversary"], "kind")),
    ]
    share = "" if row["share"] is None else f", {row['share']:.0%} of the optimum {number(row['optimum'], 2)}"
    if row["optimum"] is None:
        share = ", the optimum is unknown"
    body.append(_field("mean of 5", number(row["mean"], 2) + share))
    if row["quarantine"]:
        body.append([(f" QUARANTINED: {row['quarantine']}", TROUBLE)])
    phases = [[[], *_phase(phase, row["adversary"], width)] for phase in reversed(variation["phases"])]
    if variation["episode"] is not None:
        phases.insert(1, [[], *_episode(variation["episode"])])
    for part in phases:
        body += part
    return head, [*body, [], *_lineage(variation["lineage"], width)]


def _field(name: str, text: str) -> Line:
    return [(f" {cell(name, 12)}", DIM), (text or "none", PLAIN)]


def _phase(phase: dict[str, Any], adversary: dict[str, Any], width: int) -> list[Line]:
    """A plot of a phase's returns; its title names the phase's adversary if it differs from ``adversary``."""
    trials, optimum = phase["trials"], phase["optimum"]
    returns = by_episode(trials, phase["returns"])
    low, high = bounds(returns, optimum)
    against = "" if phase["adversary"] == adversary else f", against {parameters_text(phase['adversary'], 'kind')}"
    title: Line = [(f" RETURNS, {phase['name']}", TITLE), (f"  {len(trials)} episodes{against}", DIM)]
    if not returns:
        return [title]
    plot_width = max(10, width - 12)
    each = max(1, min(4, plot_width // len(returns)))
    drawn = plot([value for value in returns for _ in range(each)], plot_width, _HEIGHT, low, high)
    labels = [number(high)] + [""] * (_HEIGHT - 2) + [number(low)]
    rows: list[Line] = [
        [(f" {cell(label, 8, right=True)} ┤", DIM), (line, SPARK)] for label, line in zip(labels, drawn, strict=True)
    ]
    used = min(plot_width, each * len(returns))
    first, last = f"episode {trials[0] + 1}", f"{trials[-1] + 1}"
    axis = first + last.rjust(used - len(first)) if used > len(first) + len(last) else f"episodes {trials[0] + 1} to {last}"
    scale = "  top: the optimum" if optimum is not None and high == optimum else ""
    return [[*title, (scale, DIM)], *rows, [(" " * 11 + axis, DIM)]]


def _episode(episode: dict[str, Any]) -> list[Line]:
    drawing = episode["drawing"]
    title: Line = [(" EPISODE", TITLE), (f"  {episode['identity']}, return {number(episode['episode_return'])}", DIM)]
    if drawing["kind"] != "room" or drawing["size"] > _MAX_ROOM:
        return [[*title, ("; only the page (--web) draws it", DIM)]]
    rows = room(drawing["size"], drawing["goal"], drawing["path"], drawing["overridden"])
    overridden = sum(drawing["overridden"])
    text = f"number: step at which a cell was first entered; {overridden} of {len(drawing['overridden'])} steps disturbed"
    legend: Line = [
        (" ", PLAIN),
        ("0 start", _MARKS["start"]),
        ("  G or its step: goal", _MARKS["goal"]),
        ("  red: disturbed by the adversary", _MARKS["moved"]),
    ]
    drawn: list[Line] = [[("   ", PLAIN), *((cell(text, 4, right=True), _MARKS[mark]) for text, mark in row)] for row in rows]
    return [title, [(f" {text}", DIM)], *drawn, legend]


def _lineage(rows: list[dict[str, Any]], width: int) -> list[Line]:
    columns = (("identity", 20), ("return", 8), ("version", 7), ("weights_digest", 14), ("worker", max(10, width - 56)))

    def line(cells: Sequence[str]) -> str:
        parts = zip(cells, columns, strict=True)
        return " " + " ".join(cell(text, wide, name in ("return", "version")) for text, (name, wide) in parts)

    heading = "  newest first: policy version, weights digest and worker of each episode"
    lines: list[Line] = [[(" LINEAGE", TITLE), (heading, DIM)], [(line([name for name, _ in columns]), DIM)]]
    for row in reversed(rows):
        version = f"T^{row['policy_version']}" if row["policy_version"] >= 0 else "none"
        cells = (row["identity"], number(row["episode_return"]), version, row["weights_digest"][:12] or "-", row["worker"])
        style = WARNING if row["policy_version"] < 0 and row["identity"].startswith("adapt") else PLAIN
        lines.append([(line(cells), style)])
    return lines
