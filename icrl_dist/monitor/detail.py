"""One variation, as far as the live view knows it."""

from __future__ import annotations

from typing import Any

from icrl_dist.monitor.lines import ACCENT, BOLD, DIM, GOOD, PLAIN, SPARK, TITLE, TROUBLE, WARNING, Line, cell
from icrl_dist.monitor.spark import bounds, plot, room
from icrl_dist.monitor.view_state import number, summary, told

_HEIGHT = 6
"""Lines of a plot."""
_LARGEST_ROOM = 24
"""Cells along a side; of larger rooms no path is drawn."""
_MARKS = {"goal": GOOD + BOLD, "start": ACCENT + BOLD, "moved": TROUBLE, "path": PLAIN, "empty": DIM}


def lines(known: dict[str, Any], width: int) -> tuple[list[Line], list[Line]]:
    """A heading and the lines under it; ``known`` as ``RunState.variation`` tells it."""
    row = summary(known)
    head: list[Line] = [[(f" VARIATION {row['name']}", TITLE), (f"  {row['problem']}  {row['played']}", BOLD)]]
    body: list[Line] = [_field("parameters", told(row["parameters"])), _field("adversary", told(row["adversary"], "kind"))]
    share = "" if row["share"] is None else f", {row['share']:.0%} of the optimum {number(row['optimum'], 2)}"
    if row["optimum"] is None:
        share = ", nobody knows the optimum"
    body.append(_field("mean of 5", number(row["mean"], 2) + share))
    if row["quarantine"]:
        body.append([(f" QUARANTINED: {row['quarantine']}", TROUBLE)])
    phases = [[[], *_phase(phase, row["adversary"], width)] for phase in reversed(known["phases"])]
    if known["episode"] is not None:
        phases.insert(1, [[], *_episode(known["episode"])])
    for part in phases:
        body += part
    return head, [*body, [], *_lineage(known["lineage"], width)]


def _field(name: str, text: str) -> Line:
    return [(f" {cell(name, 12)}", DIM), (text or "none", PLAIN)]


def _phase(phase: dict[str, Any], adversary: dict[str, Any], width: int) -> list[Line]:
    """What was earned in a phase; its adversary too, if that is another than ``adversary``."""
    returns, trials, optimum = phase["returns"], phase["trials"], phase["optimum"]
    low, high = bounds(returns, optimum)
    against = "" if phase["adversary"] == adversary else f", against {told(phase['adversary'], 'kind')}"
    title: Line = [(f" RETURNS, {phase['name']}", TITLE), (f"  {len(returns)} episodes{against}", DIM)]
    if not returns:
        return [title]
    room_ = max(10, width - 12)
    each = max(1, min(4, room_ // len(returns)))
    drawn = plot([value for value in returns for _ in range(each)], room_, _HEIGHT, low, high)
    labels = [number(high)] + [""] * (_HEIGHT - 2) + [number(low)]
    rows: list[Line] = [
        [(f" {cell(label, 8, right=True)} ┤", DIM), (line, SPARK)] for label, line in zip(labels, drawn, strict=True)
    ]
    wide = min(room_, each * len(returns))
    first, last = f"episode {trials[0] + 1}", f"{trials[-1] + 1}"
    axis = first + last.rjust(wide - len(first)) if wide > len(first) + len(last) else f"episodes {trials[0] + 1} to {last}"
    best = "  top: the optimum" if optimum is not None and high == optimum else ""
    return [[*title, (best, DIM)], *rows, [(" " * 11 + axis, DIM)]]


def _episode(episode: dict[str, Any]) -> list[Line]:
    drawing = episode["drawing"]
    title: Line = [(" EPISODE", TITLE), (f"  {episode['identity']}, return {number(episode['episode_return'])}", DIM)]
    if drawing["kind"] != "room" or drawing["size"] > _LARGEST_ROOM:
        return [[*title, ("; the page (--web) draws it", DIM)]]
    rows = room(drawing["size"], drawing["goal"], drawing["path"], drawing["overridden"])
    pushed = sum(drawing["overridden"])
    text = f"the step at which a cell was entered; {pushed} of {len(drawing['overridden'])} moves were the adversary's"
    legend: Line = [
        (" ", PLAIN),
        ("0 start", _MARKS["start"]),
        ("  G goal, or its step", _MARKS["goal"]),
        ("  red: moved by the adversary", _MARKS["moved"]),
    ]
    drawn: list[Line] = [[("   ", PLAIN), *((cell(text, 4, right=True), _MARKS[mark]) for text, mark in row)] for row in rows]
    return [title, [(f" {text}", DIM)], *drawn, legend]


def _lineage(rows: list[dict[str, Any]], width: int) -> list[Line]:
    columns = (("identity", 20), ("return", 8), ("version", 7), ("weights_digest", 14), ("worker", max(10, width - 56)))
    found: list[Line] = [[(" LINEAGE", TITLE), ("  the newest first: which weights acted, and where", DIM)]]
    found.append([(" " + " ".join(cell(name, wide, name in ("return", "version")) for name, wide in columns), DIM)])
    for row in reversed(rows):
        weights = f"T^{row['policy_version']}" if row["policy_version"] >= 0 else "none"
        cells = (row["identity"], number(row["episode_return"]), weights, row["weights_digest"][:12] or "-", row["worker"])
        style = WARNING if row["policy_version"] < 0 and row["identity"].startswith("adapt") else PLAIN
        found.append(
            [
                (
                    " " + " ".join(cell(t, w, n in ("return", "version")) for t, (n, w) in zip(cells, columns, strict=True)),
                    style,
                )
            ]
        )
    return found
