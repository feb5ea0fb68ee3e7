"""Parsers of monitor messages: each checks the whole message before the view uses any field of it.

Every function raises InvalidMessageError for a message that does not match docs/tap.md.
"""

from __future__ import annotations

from typing import Any

from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.types import STAGES

MAX_EVENTS = 200
"""Limit on the events that are kept, and on the active alerts."""
_MAX_ENTRIES = 4096
"""Limit on the phases, and on the alerts, in one message."""
_COUNTS = ("round", "step", "steps", "version", "trajectories", "workers", "lag")


def progress(message: dict[str, Any]) -> dict[str, Any]:
    """Parse a ``learner`` message: the run's progress and the time of the message."""
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


def run_info(message: dict[str, Any]) -> dict[str, Any]:
    """Parse a ``run`` message: method, problem, phases and active alerts; ``alerts`` is None if absent (a recording)."""
    phases = [validation.bounded_list(phase, 3) for phase in validation.bounded_list(message.get("phases"), _MAX_ENTRIES)]
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
        else [_alert(validation.mapping(one)) for one in validation.bounded_list(alerts, _MAX_ENTRIES)[:MAX_EVENTS]],
    }


def _alert(entry: dict[str, Any]) -> dict[str, Any]:
    text = validation.text(entry.get("text"), 500)
    return {"name": validation.text(entry.get("name")), "text": text, "since": validation.timestamp(entry.get("since"))}


def event(message: dict[str, Any]) -> dict[str, Any]:
    """Parse an ``event`` message: its kind, text and time, and the fields of that kind of event."""
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
    """Parse a ``belief`` message: the posterior over goals that T_theta implies on a worker, and the exact one."""
    size = validation.integer(message.get("size"), 2, 64)
    goal = [validation.integer(c, 0, size - 1) for c in validation.bounded_list(message.get("goal"), 2)]
    distributions = {name: validation.numbers(message.get(name), size * size) for name in ("implied", "exact")}
    if any(len(probs) != size * size for probs in distributions.values()) or len(goal) != 2:
        raise InvalidMessageError("schema")
    return {
        "worker": validation.text(message.get("worker")),
        "identity": str(validation.identity(message.get("identity"))),
        "size": size,
        "goal": goal,
        **distributions,
    }
