"""Means over time of points that a series no longer keeps: a whole run in a bounded number of points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

_POINTS = 720
"""Points that are kept."""
_FIRST_S = 8.0
"""Time of one point at first; it doubles whenever there are too many points."""

Values = dict[str, float | None]


class History:
    """Points of equal length in time, oldest first; a point without any value is a gap, and is kept as one."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names, self._width_s = names, _FIRST_S
        self._points: list[tuple[float, Values]] = []
        self._waiting: list[tuple[float, Values]] = []
        self.seq = -1
        """``seq`` of the run state at the last change."""

    def add(self, time: float, values: Values, seq: int) -> None:
        """Take in the next point of the series, in order of time."""
        gap = all(value is None for value in values.values())
        if self._waiting and (gap or time - self._waiting[0][0] >= self._width_s):
            self._points.append(self._mean(self._waiting))
            self._waiting, self.seq = [], seq
        if gap:
            self._points.append((time, values))
            self.seq = seq
        else:
            self._waiting.append((time, values))
        while len(self._points) > _POINTS:
            self._halve()

    def _halve(self) -> None:
        """Replace two neighbors by their mean everywhere; gaps stay, unless there is little else."""
        before, merged, first = len(self._points), list[tuple[float, Values]](), list[tuple[float, Values]]()
        for point in self._points:
            if all(value is None for value in point[1].values()):
                merged += [*first, point]
                first = []
            elif first:
                merged.append(self._mean([*first, point]))
                first = []
            else:
                first = [point]
        self._points = [*merged, *first]
        self._width_s *= 2
        if len(self._points) > 0.9 * before:
            del self._points[: before // 4]

    def _mean(self, points: Sequence[tuple[float, Values]]) -> tuple[float, Values]:
        columns = {name: [v for _, values in points if (v := values[name]) is not None] for name in self._names}
        return points[-1][0], {name: sum(found) / len(found) if found else None for name, found in columns.items()}

    def columns(self) -> dict[str, Any]:
        """``t`` (Unix seconds) and each series; None for no value."""
        times = [round(time, 3) for time, _ in self._points]
        return {"t": times, **{name: [values[name] for _, values in self._points] for name in self._names}}
