"""Messages of the monitor plane, each read as a whole before any of it is believed.

Every function raises InvalidMessageError for a message that is not what docs/tap.md says.
"""

from __future__ import annotations

from typing import Any

from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.types import STAGES

EVENTS = 200
"""Events that are remembered, and alerts that are on, at most."""
_TOLD = 4096
"""Phases, and alerts, of which a message tells, at most."""
_COUNTS = ("round", "step", "steps", "version", "trajectories", "workers", "lag")


def progress(message: dict[str, Any]) -> dict[str, Any]:
    """Of a ``learner`` message: how far the run is, and when that was said."""
    stage, phase, loss = (message.get(name) for name in ("stage", "phase", "loss"))
    if stage not in ("collect", "fit") or phase not in STAGES:
        raise InvalidMessageError("schema")
    found = {name: validation.integer(message.get(name), -1) for name in _COUNTS}
    return {
        **found,
        "stage": stage,
        "phase": phase,
        "drops": validation.counts(message.get("drops")),
        "doing": [validation.text(line, 200) for line in validation.bounded_list(message.get("doing"), 64)],
        "time": validation.timestamp(message.get("time")),
        **({} if loss is None else {"loss": validation.number(loss)}),
    }


def about(message: dict[str, Any]) -> dict[str, Any]:
    """Of a ``run`` message: what the run is about, and the alerts that are on; None where it does not say (a recording)."""
    phases = [validation.bounded_list(phase, 3) for phase in validation.bounded_list(message.get("phases"), _TOLD)]
    alerts = message.get("alerts")
    return {
        **{name: validation.text(message.get(name), longest) for name, longest in (("method", 32), ("problem", 64))},
        **{name: validation.integer(message.get(name), 0, 10**7) for name in ("tasks", "variations", "rounds")},
        "began": validation.timestamp(message.get("began")),
        "phases": [
            (validation.text(p[0], 32), validation.integer(p[1], 0), validation.integer(p[2], 0)) for p in phases if len(p) == 3
        ],
        "alerts": None
        if alerts is None
        else [_alert(validation.mapping(one)) for one in validation.bounded_list(alerts, _TOLD)[:EVENTS]],
    }


def _alert(told: dict[str, Any]) -> dict[str, Any]:
    text = validation.text(told.get("text"), 500)
    return {"name": validation.text(told.get("name")), "text": text, "since": validation.timestamp(told.get("since"))}


def event(message: dict[str, Any]) -> dict[str, Any]:
    """Of an ``event`` message: what happened, and what belongs to events of that sort."""
    what = validation.text(message.get("what"), 32)
    found = {"what": what, "text": validation.text(message.get("text"), 500), "time": validation.timestamp(message.get("time"))}
    if what == "worker":
        found |= {"worker": validation.text(message.get("worker")), "alive": bool(message.get("alive"))}
    elif what == "alert":
        found |= {"alert": validation.text(message.get("alert")), "active": bool(message.get("active"))}
    elif what in ("quarantine", "released"):
        found["identity"] = validation.identity(f"{validation.text(message.get('identity'), 120)}/0")
    elif what == "version":
        found["version"] = validation.integer(message.get("version"), 0)
    return found


def belief(message: dict[str, Any]) -> dict[str, Any]:
    """Of a ``belief`` message: where a worker's T_theta believes the goal to be."""
    size = validation.integer(message.get("size"), 2, 64)
    goal = [validation.integer(c, 0, size - 1) for c in validation.bounded_list(message.get("goal"), 2)]
    laws = {name: validation.numbers(message.get(name), size * size) for name in ("implied", "exact")}
    if any(len(law) != size * size for law in laws.values()) or len(goal) != 2:
        raise InvalidMessageError("schema")
    return {
        "worker": validation.text(message.get("worker")),
        "identity": str(validation.identity(message.get("identity"))),
        "size": size,
        "goal": goal,
        **laws,
    }
