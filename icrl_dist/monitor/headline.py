"""The one sentence on top, which every view shows: where the run is, how it is, and what it is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from icrl_dist.console.phase_names import round_text

_TROUBLE = ("gone", "silent")
_OVER = {"interrupted": "Interrupted", "failed": "Failed", "finished": "Training finished", "evaluating": "Training finished"}


def headline(
    run: Mapping[str, Any], workers: Sequence[Mapping[str, Any]], alerts: int, evaluation: Mapping[str, Any] | None
) -> str:
    """One sentence.  ``run``, ``workers`` and ``evaluation`` as in a snapshot; ``alerts``: number of active alerts."""
    state = run["state"]
    if state == "waiting":
        return "Waiting for a learner."
    over = state in _OVER
    parts = [_OVER[state] if over else round_text(run) or "Starting"]
    if over:
        if run.get("elapsed_s") is not None:
            parts[0] += f" after {_time(run['elapsed_s'])}"
        parts += [] if state in ("finished", "evaluating") else [round_text(run)]
    else:
        parts.append(f"{_time(run['eta_s'])} left" if run.get("eta_s") is not None else "time left not known yet")
    parts.append(_health(run, workers, alerts, over))
    return f"{', '.join(part for part in parts if part)}; {worth(run, evaluation, over)}."


def _health(run: Mapping[str, Any], workers: Sequence[Mapping[str, Any]], alerts: int, over: bool) -> str:
    if run["state"] == "silent":
        return f"nothing heard for {_time(run.get('silent_s') or 0.0)}"
    trouble = 0 if over else sum(row["state"] in _TROUBLE for row in workers)
    found = [_count(alerts, "alert")] if alerts else []
    found += [f"{_count(trouble, 'worker')} gone or silent"] if trouble else []
    return " and ".join(found) or ("" if over else "healthy")


def worth(run: Mapping[str, Any], evaluation: Mapping[str, Any] | None, over: bool) -> str:
    """The held-out return of the newest model at the largest p, beside T^0, in the words of ``results.comparison``."""
    if evaluation is None:
        if run["state"] == "evaluating":
            return "the held-out evaluation is running"
        return "no held-out returns yet" if over else "held-out returns follow after the training"
    level = max(evaluation["levels"], key=lambda one: float(one["p"]))
    agents = {agent["role"]: agent for agent in reversed(level["agents"])}
    first = next((agent for agent in level["agents"] if agent["key"] == "t0"), None)
    newest = agents.get("newest")
    if newest is None:
        return "no held-out returns of a model"
    of = f" of {level['ceiling']}" if newest["share"] and newest["share"][0] is not None else ""
    which = "share" if of else "value"
    text = f"held-out (p = {level['p']:g}) {newest['name'].partition(' ')[0]} {_value(newest[which])}{of}"
    if level["verdict"] is None or first is None:
        return text
    alone = ", in this training" if evaluation["trainings"] == 1 else ""
    words = {"higher": f"a gain{alone}", "lower": f"a loss{alone}", "not shown": f"a gain is not shown{'' if over else ' yet'}"}
    again = ", evaluated again now" if run["state"] == "evaluating" else ""
    return f"{text}, T^0 {_value(first[which])}: {words[level['verdict']]}{again}"


def _value(numbers: Sequence[float | None] | None) -> str:
    return "-" if not numbers or numbers[0] is None else f"{numbers[0]:.2f}"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _time(seconds: float) -> str:
    """A duration in words: ``45 s``, ``6 min``, ``3.2 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
