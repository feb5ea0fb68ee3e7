"""Rates of a run over time, and estimates of the time that remains."""

from __future__ import annotations

from collections import deque
from typing import Any

from icrl_dist.monitor.history import History

_POINTS = 900
"""Points kept of each series, one a second; a history keeps means of the older ones."""
_PERIOD_S = 1.0
"""Time between points."""
_GAP_S = 10.0
"""Without a point for this time, nothing is known in between."""
_OF_WORKERS = ("episodes_per_s", "steps_per_s", "unstored")
SERIES = ("stored_per_s", "episodes_per_s", "steps_per_s", "fit_per_s", "loss", "lag", "unstored")


class RateSeries:
    """Time series with one point a second, and estimates of the remaining time from them."""

    def __init__(self) -> None:
        self.phases: list[tuple[str, int, int]] = []
        """Stage, round and optimizer steps of every phase of the run, in order."""
        self.rates: dict[str, float] = {}
        """Newest value of each series."""
        self._points: deque[tuple[int, int, float, dict[str, float | None]]] = deque(maxlen=_POINTS)
        """Number of the point, ``seq`` of the run state, time, and the value of each series."""
        self._history = History(SERIES)
        self._number = self._episodes = 0
        self._last: tuple[float, int, int] | None = None
        """Time, stored trajectories and finished episodes at the newest point."""
        self._stage: tuple[tuple[str, str, int], float, int] | None = None
        """The current stage, when it was first seen, and its step then."""
        self._stage_per_s: float | None = None
        self._fit_per_s: float | None = None
        self._collected_s: dict[str, float] = {}

    def count_episodes(self, episodes: int) -> None:
        """Add episodes that workers have finished."""
        self._episodes += episodes

    def update(self, run: dict[str, Any], now: float) -> None:
        """Take in the learner's progress message."""
        name, step = (run["stage"], run["phase"], run["round"]), run["step"]
        if self._stage is None:  # trajectories stored before the view started do not count for a rate
            self._last = (now, run["trajectories"], self._episodes)
        if self._stage is None or self._stage[0] != name or step < self._stage[2]:
            self._stage, self._stage_per_s = (name, now, step), None
        _, began, first = self._stage
        if step > first and now - began > 0.2:
            self._stage_per_s = (step - first) / (now - began)
            if run["stage"] == "fit":
                self._fit_per_s = self._stage_per_s
            else:
                self._collected_s[run["phase"]] = run["steps"] / self._stage_per_s

    def tick(
        self, now: float, seq: int, run: dict[str, Any], steps_per_s: float, unstored: int, partial: bool, apart_s: float = 0.0
    ) -> None:
        """Add a point if a second has passed; after a gap also one without values, so that no line is drawn across it.

        ``partial``: the values of workers are unknown; ``apart_s``: the messages are this far apart, so this is no gap.
        """
        if self._last is None:
            self._last = (now, run["trajectories"], self._episodes)
        before, stored, episodes = self._last
        span = now - before
        if 0 <= span < _PERIOD_S:
            return
        self._last = (now, run["trajectories"], self._episodes)
        if span > _GAP_S + 2 * apart_s and self._points:
            self._append(seq, before + _PERIOD_S, dict.fromkeys(SERIES))
        fitting, span = run.get("stage") == "fit", max(span, 1e-3)
        values: dict[str, float | None] = {
            "stored_per_s": max(0, run["trajectories"] - stored) / span,
            "episodes_per_s": (self._episodes - episodes) / span,
            "steps_per_s": steps_per_s,
            "fit_per_s": self._stage_per_s if fitting else 0.0,
            "loss": run.get("loss") if fitting else None,
            "lag": run.get("lag"),
            "unstored": unstored,
        }
        if partial:
            values |= dict.fromkeys(_OF_WORKERS)
        self._append(seq, now, values)
        self.rates = {name: value for name, value in values.items() if value is not None}

    def _append(self, seq: int, now: float, values: dict[str, float | None]) -> None:
        self._number += 1
        if len(self._points) == _POINTS:
            _, _, time, oldest = self._points[0]
            self._history.add(time, oldest, seq)
        self._points.append((self._number, seq, now, values))

    def series(self, since: int) -> dict[str, Any]:
        """Columns of the points added after ``since``: ``number``, ``t`` (Unix seconds) and each series; None for no value."""
        points = [point for point in self._points if point[1] > since]
        columns: dict[str, Any] = {"number": [p[0] for p in points], "t": [round(p[2], 3) for p in points]}
        return columns | {name: [p[3][name] for p in points] for name in SERIES}

    def history(self, since: int) -> dict[str, Any] | None:
        """Columns of means of older points, as ``series`` without ``number``; None if nothing has changed after ``since``."""
        return self._history.columns() if self._history.seq > since else None

    def stage_eta_s(self, run: dict[str, Any]) -> float | None:
        """Estimated seconds until the current stage ends, from its rate so far; None while the rate is unknown."""
        if not self._stage_per_s:
            return None
        return float(max(0, run["steps"] - run["step"]) / self._stage_per_s)

    def eta_s(self, run: dict[str, Any]) -> float | None:
        """Estimated seconds until the fit of the last phase ends; None while a rate that the estimate needs is unknown."""
        stage_s, phase = self.stage_eta_s(run), (run.get("phase"), run.get("round"))
        index = next((i for i, (stage, round_, _) in enumerate(self.phases) if (stage, round_) == phase), None)
        if stage_s is None or index is None or not self._fit_per_s:
            return None
        total = stage_s + (self.phases[index][2] / self._fit_per_s if run["stage"] == "collect" else 0.0)
        for stage, _, steps in self.phases[index + 1 :]:
            if stage not in self._collected_s:
                return None
            total += self._collected_s[stage] + steps / self._fit_per_s
        return total
