"""Converts episodes to drawings of few numbers, and computes the optimum of a variation where that is possible.

A drawing is one of

- ``room``: ``size``, ``goal``, ``path`` (cells, one more than steps), ``overridden`` (one flag a step);
- ``sticks``: ``frames``, each a list of segments ``[x0, y0, x1, y1]`` in meters, ``frame_s`` seconds apart, and
  ``force`` (0 to 1, one value a frame);
- ``paths``: ``paths``, named lists of points from above in meters, and ``goal``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_values
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.stream import validation as strict
from icrl_dist.types import Adversary, Task, Variation

_LARGEST_ROOM, _LONGEST = 32, 1000
"""Size and horizon up to which the optimum is computed."""
_HAND, _OBJECT = slice(0, 2), slice(4, 6)
"""Components of Meta-World's observation with x and y of hand and object."""


def of(message: dict[str, Any]) -> dict[str, Any]:
    """The drawing of an ``episode`` message.  Raises InvalidMessageError if it does not match docs/tap.md."""
    kind = validation.text(message.get("problem"), 64)
    try:
        states = strict.to_array("observations", message.get("observations"), ("<f4",), 2)
        adversary = strict.to_array("adversary", message.get("adversary"), ("<f4",), 1)
    except strict.WireError:
        raise InvalidMessageError("schema") from None
    if not (0 < len(states) <= 512 and len(adversary) <= len(states) and states.shape[1] <= 128):
        raise InvalidMessageError("schema")
    if not (np.isfinite(states).all() and np.isfinite(adversary).all()):
        raise InvalidMessageError("schema")
    parameters = validation.parameters(message.get("task"))
    if kind == "darkroom":
        return _room(states, adversary, parameters)
    if kind == pick_place.KIND:
        return _paths(states, parameters)
    if kind in domains.PROBLEMS and states.shape[1] == len(domains.PROBLEMS[kind].scale):
        from icrl_dist.problems.dmc import picture

        frames, force = picture.sticks(kind, states), _rounded(np.minimum(adversary, 1.0))
        frame_s = validation.integer(message.get("every"), 1, 512) * picture.step_s(kind)
        return {"kind": "sticks", "frames": frames, "frame_s": frame_s, "force": force}
    raise InvalidMessageError("schema")


def _room(states: np.ndarray, adversary: np.ndarray, parameters: dict[str, Any]) -> dict[str, Any]:
    size = validation.integer(parameters.get("size"), 2, 256)
    goal = [validation.integer(c, 0, size - 1) for c in validation.bounded_list(parameters.get("goal"), 2)]
    if states.shape[1] != 2 or len(goal) != 2:
        raise InvalidMessageError("schema")
    path = np.rint(states).astype(np.int64).clip(0, size - 1)
    return {"kind": "room", "size": size, "goal": goal, "path": path.tolist(), "overridden": (adversary >= 0).tolist()}


def _paths(states: np.ndarray, parameters: dict[str, Any]) -> dict[str, Any]:
    goal = validation.numbers(parameters.get("goal"), 3)
    if states.shape[1] < 7 or len(goal) != 3:
        raise InvalidMessageError("schema")
    drawn = {"hand": _HAND, "object": _OBJECT}
    paths = [{"name": name, "points": [_rounded(p) for p in states[:, place]]} for name, place in drawn.items()]
    return {"kind": "paths", "paths": paths, "goal": _rounded(np.array(goal[:2]))}


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 3) for value in values]


def optimum(problem: str, task: dict[str, Any], adversary: dict[str, Any]) -> float | None:
    """The optimal undiscounted return of a Dark Room variation, its mean over start cells; None for other problems,
    for large rooms, and for parameters that are invalid or give no finite number."""
    size, horizon = task.get("size"), task.get("horizon")
    if problem != "darkroom" or not isinstance(size, int) or not isinstance(horizon, int):
        return None
    if not (2 <= size <= _LARGEST_ROOM and 1 <= horizon <= _LONGEST):
        return None
    try:
        others = {name: _value(value) for name, value in adversary.items() if name != "kind"}
        room = Task.of("darkroom", **{name: _value(value) for name, value in task.items()})
        law = Adversary.of(str(adversary.get("kind")), **others)
        with np.errstate(all="ignore"):
            values = optimal_values(Hypotheses.of([Variation(room, law)]))[0]
        start = task.get("start", "random")
        best = float(values.mean() if start == "random" else values[int(start[0]) * size + int(start[1])])
        return best if math.isfinite(best) else None
    except (ValueError, KeyError, TypeError, IndexError, ArithmeticError):
        return None  # the parameters come from an untrusted message


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
