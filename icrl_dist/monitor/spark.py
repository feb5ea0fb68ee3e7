"""Text drawings: sparklines, progress bars, small plots, and Dark Rooms from above."""

from __future__ import annotations

import math
from collections.abc import Sequence

BLOCKS = " ▁▂▃▄▅▆▇█"
"""From empty to full in steps of an eighth."""
_EIGHTHS = len(BLOCKS) - 1

Values = Sequence[float | None]


def bounds(values: Values, ceiling: float | None = None) -> tuple[float, float]:
    """Lower and upper bound of a plot of returns: they include zero, the values and ``ceiling`` (the optimum)."""
    known = [value for value in values if value is not None]
    low = min([0.0, *known])
    high = max([0.0, *known, *([ceiling] if ceiling is not None else [])])
    return low, high if high > low else low + 1.0


def resample(values: Values, width: int) -> list[float | None]:
    """At most ``width`` values: the means of equal buckets of adjacent values; None where a bucket has no value."""
    if len(values) <= width:
        return list(values)
    means: list[float | None] = []
    for bucket in range(width):
        first, last = bucket * len(values) // width, (bucket + 1) * len(values) // width
        known = [value for value in values[first:last] if value is not None]
        means.append(sum(known) / len(known) if known else None)
    return means


def spark(values: Values, width: int, low: float, high: float) -> str:
    """A line of at most ``width`` blocks; the lowest value is one eighth high, an unknown value is a space."""
    return "".join(
        " " if value is None else BLOCKS[1 + min(_EIGHTHS - 1, _eighths(value, low, high, _EIGHTHS))]
        for value in resample(values, width)
    )


def plot(values: Values, width: int, height: int, low: float, high: float) -> list[str]:
    """``height`` lines of at most ``width`` columns, top line first; the lowest value is one eighth high."""
    whole = height * _EIGHTHS
    tops = [0 if value is None else 1 + min(whole - 1, _eighths(value, low, high, whole)) for value in resample(values, width)]
    return ["".join(BLOCKS[min(_EIGHTHS, max(0, top - row * _EIGHTHS))] for top in tops) for row in range(height - 1, -1, -1)]


def _eighths(value: float, low: float, high: float, whole: int) -> int:
    """Number of the ``whole`` equal steps from low to high that lie below a value."""
    share = (value - low) / (high - low) if high > low else 0.0
    return math.floor(min(1.0, max(0.0, share)) * whole + 1e-9)


def bar(share: float, width: int) -> tuple[str, str]:
    """The done part and the remaining part of a progress bar."""
    done = round(min(1.0, max(0.0, share)) * width)
    return "━" * done, "─" * (width - done)


Mark = tuple[str, str]
"""A cell's text and its kind: ``goal``, ``start``, ``path``, ``moved`` (by the adversary) or ``empty``."""


def room(size: int, goal: Sequence[int], path: Sequence[Sequence[int]], overridden: Sequence[bool]) -> list[list[Mark]]:
    """A Dark Room episode from above: x to the right, y upwards, top row first.

    A cell contains the step at which it was first entered, 0 at the start; a goal that was never
    entered contains ``G``.
    """
    entered: dict[tuple[int, int], int] = {}
    for number, (x, y) in enumerate(path):
        entered.setdefault((x, y), number)
    rows = []
    for y in range(size - 1, -1, -1):
        row: list[Mark] = []
        for x in range(size):
            step = entered.get((x, y))
            if [x, y] == list(goal):
                row.append(("G" if step is None else str(step), "goal"))
            elif step is None:
                row.append(("·", "empty"))
            elif step == 0:
                row.append(("0", "start"))
            else:
                pushed = step <= len(overridden) and overridden[step - 1]
                row.append((str(step), "moved" if pushed else "path"))
        rows.append(row)
    return rows
