"""Dark Room in live views: the drawing of an episode, and the optimum of a variation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_values
from icrl_dist.types import Adversary, Task, Variation

_LARGEST_DRAWN = 256
"""Maximum size of a room that is drawn."""
_LARGEST_SOLVED, _LONGEST_SOLVED = 32, 1000
"""Maximum size and horizon of a room whose optimum is computed."""


def drawing(states: np.ndarray, adversary: np.ndarray, task: Mapping[str, Any], every: int) -> dict[str, Any]:
    """A ``room`` drawing: ``size``, ``goal``, ``path`` (cells, one more than steps), ``overridden`` (one per step).

    Raises ValueError for values that describe no room.
    """
    size, goal = task.get("size"), task.get("goal")
    if type(size) is not int or not 2 <= size <= _LARGEST_DRAWN or not isinstance(goal, (list, tuple)) or len(goal) != 2:
        raise ValueError("no room")
    if states.shape[1] != 2 or not all(type(c) is int and 0 <= c < size for c in goal):
        raise ValueError("no room")
    path = np.rint(states).astype(np.int64).clip(0, size - 1)
    return {"kind": "room", "size": size, "goal": list(goal), "path": path.tolist(), "overridden": (adversary >= 0).tolist()}


def message_optimum(task: Mapping[str, Any], adversary: Mapping[str, Any]) -> float | None:
    """Expected undiscounted return of the optimal policy of a variation, averaged over its start cells.

    None if the message does not describe a room and an adversary, or if the room is too large.
    """
    size, horizon = task.get("size"), task.get("horizon")
    if not isinstance(size, int) or not isinstance(horizon, int):
        return None
    if not (2 <= size <= _LARGEST_SOLVED and 1 <= horizon <= _LONGEST_SOLVED):
        return None
    try:
        others = {name: _value(value) for name, value in adversary.items() if name != "kind"}
        room = Task.of("darkroom", **{name: _value(value) for name, value in task.items()})
        disturbance = Adversary.of(str(adversary.get("kind")), **others)
        with np.errstate(all="ignore"):
            values = optimal_values(Hypotheses.of([Variation(room, disturbance)]))[0]
        start = task.get("start", "random")
        best = float(values.mean() if start == "random" else values[int(start[0]) * size + int(start[1])])
        return best if math.isfinite(best) else None
    except (ValueError, KeyError, TypeError, IndexError, ArithmeticError):
        return None  # messages are not validated before


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
