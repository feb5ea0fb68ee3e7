"""Converts episodes to drawings of few numbers, and computes the optimum of a variation where that is possible.

A drawing is one of

- ``room``: ``size``, ``goal``, ``path`` (cells, one more than steps), ``overridden`` (one flag a step);
- ``sticks``: ``frames``, each a list of segments ``[x0, y0, x1, y1]`` in meters, ``frame_s`` seconds apart, and
  ``force`` (0 to 1, one value a frame), ``travel`` (meters forward, one value a frame, or empty), and ``ground``
  (its height, or None);
- ``arm``: ``hand`` and ``object``, ``[x, y, z]`` in meters for each frame, ``opening`` of the gripper (0 to 1), and ``goal``;
- ``paths``: ``paths``, named lists of points from above in meters, and ``goal``.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from icrl_dist.config.run import ConfigError
from icrl_dist.interfaces import Problem
from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.problems import registry
from icrl_dist.stream import validation as strict


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
    every = validation.integer(message.get("every"), 1, 512)
    problem = _problem(kind)
    if problem is None or problem.drawing is None:
        raise InvalidMessageError("schema")
    try:
        return problem.drawing(states, adversary, parameters, every)
    except ValueError:
        raise InvalidMessageError("schema") from None


def optimum(problem: str, task: dict[str, Any], adversary: dict[str, Any]) -> float | None:
    """The optimal undiscounted return of a variation, over its start cells; None where it cannot be computed."""
    found = _problem(problem)
    return None if found is None or found.message_optimum is None else found.message_optimum(task, adversary)


@functools.lru_cache(maxsize=64)
def _problem(name: str) -> Problem | None:
    """The problem of this name; None if it is not installed here, or if its package cannot be imported: tried once."""
    try:
        return registry.problem(name)
    except ConfigError:
        return None
