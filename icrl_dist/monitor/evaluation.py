"""What a run is worth on held-out tasks, read from its folder: the result rows of its evaluation, and whether one runs."""

from __future__ import annotations

import logging
import math
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icrl_dist.config.run import ConfigError
from icrl_dist.monitor.run_state import RunState
from icrl_dist.results import comparison, rows, statistics, summaries
from icrl_dist.results.names import key_of
from icrl_dist.results.returns import LAST, Returns, returns
from icrl_dist.results.statistics import Interval
from icrl_dist.storage.files import StoreError, held

if TYPE_CHECKING:
    import pandas as pd

_log = logging.getLogger(__name__)

_PERIOD_S = 2.0
"""Seconds between two looks at the folder."""


def running(folder: Path) -> bool:
    """Whether a process without a learner holds the run folder: once the training is finished, this is its evaluation."""
    return held(folder) and not (folder / "endpoint").exists()


def held_out(folder: Path) -> dict[str, Any] | None:
    """The held-out returns of a run folder for views, as JSON values (docs/monitor.md); None if there are none.

    They are those of the models, of the random policy, and of the references that are given the task.
    Raises ConfigError or StoreError for rows that cannot be shown together.
    """
    if not any((folder / "results").glob("online-*.parquet")):
        return None
    frame = rows.read_results(folder, unfinished=True)
    return of_rows(frame[frame["suite"] == "online"].reset_index(drop=True))


def of_rows(frame: pd.DataFrame) -> dict[str, Any] | None:
    """As ``held_out``, from rows of the suite ``online``."""
    if frame.empty:
        return None
    found = returns(frame)
    newest = {one.p: one for one in comparison.newest_model(frame)} if any(one.agent.is_model for one in found) else {}
    estimates, best = summaries.intervals(found), summaries.ceilings(found)
    trainings, tasks, evaluations, episodes = found[0].returns.shape
    levels = []
    for p in dict.fromkeys(one.p for one in found):
        here = [one for one in found if one.p == p]
        shown = [one for one in here if one.agent.is_model or one.ceiling or one.agent.agent == "random"]
        levels.append(
            {
                "p": p,
                "ceiling": next((best[p, one.agent].name for one in here if (p, one.agent) in best), None),
                "agents": [_agent(one, *estimates[p, one.agent], newest.get(p)) for one in shown],
                "left_out": len(here) - len(shown),
                **_gain(here, newest.get(p)),
            }
        )
    return {
        "levels": levels,
        "trainings": trainings,
        "tasks": tasks,
        "evaluations": evaluations,
        "last": min(LAST, episodes),
        "over": statistics.resampled(trainings, tasks, evaluations, min(LAST, episodes)),
    }


def _agent(one: Returns, value: Interval, share: Interval | None, newest: Returns | None) -> dict[str, Any]:
    role = "newest" if newest is not None and one.agent == newest.agent else "model" if one.agent.is_model else "reference"
    mean, _ = one.by_episode()
    return {
        "name": one.name,
        "key": one.agent.agent,
        "role": role,
        "value": _numbers(value),
        "share": None if share is None else _numbers(share),
        "episodes": [round(float(each), 4) for each in mean],
    }


def _gain(here: list[Returns], newest: Returns | None) -> dict[str, Any]:
    """Newest model less T^0: ``gain``, its interval, and ``verdict``; None where there is no earlier T^0."""
    firsts = [one for one in here if one.agent.agent == key_of(0)]
    if newest is None or not firsts or newest.agent.agent == key_of(0):
        return {"gain": None, "verdict": None}
    first = next((one for one in firsts if one.agent.deployment == newest.agent.deployment), firsts[0])
    mean = comparison.compare(first, newest)[0]
    return {"gain": _numbers(mean.effect), "verdict": mean.verdict}


def _numbers(of: Interval) -> list[float | None]:
    """Value, low and high; None for nan."""
    return [None if math.isnan(one) else round(float(one), 4) for one in of]


class EvaluationReader:
    """Keeps what a run state knows of the evaluation up to date, from the run folder on this machine."""

    def __init__(self, folder: Path, state: RunState) -> None:
        self._folder, self._state = folder, state
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="evaluation", daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        read: list[str] | None = None
        found: dict[str, Any] | None = None
        while True:
            files = sorted(path.name for path in (self._folder / "results").glob("online-*.parquet"))
            if files != read:
                read = files
                try:
                    found = held_out(self._folder)
                except (ConfigError, StoreError) as error:
                    _log.warning("held-out returns are not shown: %s", error)
                    found = None
            self._state.set_evaluation(found, running(self._folder))
            if self._ended.wait(_PERIOD_S):
                return

    def close(self) -> None:
        self._ended.set()
        self._thread.join(10.0)
