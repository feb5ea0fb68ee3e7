"""How fast a run goes: rates over time, and when it will be done."""

from __future__ import annotations

from collections import deque
from typing import Any

_POINTS = 900
"""Points kept of each series."""
_PERIOD_S = 1.0
"""Time between points."""
SERIES = ("stored_per_s", "episodes_per_s", "steps_per_s", "fit_per_s", "loss", "lag", "unstored")


class RateSeries:
    """Series of a point a second, and estimates from them."""

    def __init__(self) -> None:
        self.phases: list[tuple[str, int, int]] = []
        """Stage, round and optimizer steps of every phase of the run, in order."""
        self.rates: dict[str, float] = {}
        """The newest point, by name of series."""
        self._points: deque[tuple[int, int, float, dict[str, float | None]]] = deque(maxlen=_POINTS)
        self._number = self._episodes = 0
        self._mark: tuple[float, int, int] | None = None
        self._stage: tuple[tuple[str, str, int], float, int] | None = None
        self._stage_per_s: float | None = None
        self._fit_per_s: float | None = None
        self._collected_s: dict[str, float] = {}

    def produced(self, episodes: int) -> None:
        """Workers finished so many."""
        self._episodes += episodes

    def progress(self, run: dict[str, Any], now: float) -> None:
        """The learner told how far it is."""
        name, step = (run["stage"], run["phase"], run["round"]), run["step"]
        if self._stage is None:  # what was stored before anybody watched is no rate
            self._mark = (now, run["trajectories"], self._episodes)
        if self._stage is None or self._stage[0] != name or step < self._stage[2]:
            self._stage, self._stage_per_s = (name, now, step), None
        _, began, first = self._stage
        if step > first and now - began > 0.2:
            self._stage_per_s = (step - first) / (now - began)
            if run["stage"] == "fit":
                self._fit_per_s = self._stage_per_s
            else:
                self._collected_s[run["phase"]] = run["steps"] / self._stage_per_s

    def tick(self, now: float, seq: int, run: dict[str, Any], steps_per_s: float, unstored: int) -> None:
        """Another point, if a second has passed."""
        if self._mark is None:
            self._mark = (now, run["trajectories"], self._episodes)
        then, stored, episodes = self._mark
        span = now - then
        if 0 <= span < _PERIOD_S:
            return
        self._mark = (now, run["trajectories"], self._episodes)
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
        self._number += 1
        self._points.append((self._number, seq, now, values))
        self.rates = {name: value for name, value in values.items() if value is not None}

    def series(self, since: int) -> dict[str, Any]:
        """Columns of the points made after ``since``: ``number``, ``t`` (Unix seconds) and each series; None for no value."""
        points = [point for point in self._points if point[1] > since]
        columns: dict[str, Any] = {"number": [p[0] for p in points], "t": [round(p[2], 3) for p in points]}
        return columns | {name: [p[3][name] for p in points] for name in SERIES}

    def stage_eta_s(self, run: dict[str, Any]) -> float | None:
        """Seconds until the stage at hand is done, by its rate so far; None while that is not known."""
        if not self._stage_per_s:
            return None
        return float(max(0, run["steps"] - run["step"]) / self._stage_per_s)

    def eta_s(self, run: dict[str, Any]) -> float | None:
        """Seconds until the last phase is fitted; None while a rate that this needs was never seen."""
        here, at = self.stage_eta_s(run), (run.get("phase"), run.get("round"))
        place = next((i for i, (stage, round_, _) in enumerate(self.phases) if (stage, round_) == at), None)
        if here is None or place is None or not self._fit_per_s:
            return None
        total = here + (self.phases[place][2] / self._fit_per_s if run["stage"] == "collect" else 0.0)
        for stage, _, steps in self.phases[place + 1 :]:
            if stage not in self._collected_s:
                return None
            total += self._collected_s[stage] + steps / self._fit_per_s
        return total
