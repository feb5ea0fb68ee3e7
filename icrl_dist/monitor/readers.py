"""Messages of the monitor plane, each read as a whole before any of it is believed.

Every function raises Odd for a message that is not what docs/tap.md says.
"""

from __future__ import annotations

from typing import Any

from icrl_dist.monitor import plain
from icrl_dist.monitor.plain import Odd
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
        raise Odd("schema")
    found = {name: plain.integer(message.get(name), -1) for name in _COUNTS}
    return {
        **found,
        "stage": stage,
        "phase": phase,
        "drops": plain.counts(message.get("drops")),
        "doing": [plain.text(line, 200) for line in plain.listed(message.get("doing"), 64)],
        "time": plain.when(message.get("time")),
        **({} if loss is None else {"loss": plain.number(loss)}),
    }


def about(message: dict[str, Any]) -> dict[str, Any]:
    """Of a ``run`` message: what the run is about, and the alerts that are on; None where it does not say (a recording)."""
    phases = [plain.listed(phase, 3) for phase in plain.listed(message.get("phases"), _TOLD)]
    alerts = message.get("alerts")
    return {
        **{name: plain.text(message.get(name), longest) for name, longest in (("method", 32), ("problem", 64))},
        **{name: plain.integer(message.get(name), 0, 10**7) for name in ("tasks", "variations", "rounds")},
        "began": plain.when(message.get("began")),
        "phases": [(plain.text(p[0], 32), plain.integer(p[1], 0), plain.integer(p[2], 0)) for p in phases if len(p) == 3],
        "alerts": None if alerts is None else [_alert(plain.mapped(one)) for one in plain.listed(alerts, _TOLD)[:EVENTS]],
    }


def _alert(told: dict[str, Any]) -> dict[str, Any]:
    text = plain.text(told.get("text"), 500)
    return {"name": plain.text(told.get("name")), "text": text, "since": plain.when(told.get("since"))}


def event(message: dict[str, Any]) -> dict[str, Any]:
    """Of an ``event`` message: what happened, and what belongs to events of that sort."""
    what = plain.text(message.get("what"), 32)
    found = {"what": what, "text": plain.text(message.get("text"), 500), "time": plain.when(message.get("time"))}
    if what == "worker":
        found |= {"worker": plain.text(message.get("worker")), "alive": bool(message.get("alive"))}
    elif what == "alert":
        found |= {"alert": plain.text(message.get("alert")), "active": bool(message.get("active"))}
    elif what in ("quarantine", "released"):
        found["identity"] = plain.identity(f"{plain.text(message.get('identity'), 120)}/0")
    elif what == "version":
        found["version"] = plain.integer(message.get("version"), 0)
    return found


def belief(message: dict[str, Any]) -> dict[str, Any]:
    """Of a ``belief`` message: where a worker's T_theta believes the goal to be."""
    size = plain.integer(message.get("size"), 2, 64)
    goal = [plain.integer(c, 0, size - 1) for c in plain.listed(message.get("goal"), 2)]
    laws = {name: plain.numbers(message.get(name), size * size) for name in ("implied", "exact")}
    if any(len(law) != size * size for law in laws.values()) or len(goal) != 2:
        raise Odd("schema")
    return {
        "worker": plain.text(message.get("worker")),
        "identity": str(plain.identity(message.get("identity"))),
        "size": size,
        "goal": goal,
        **laws,
    }
