"""Tasks of Meta-World's ML1 pick-place (appendix C.2); this module does not import the simulator."""

from __future__ import annotations

from collections.abc import Sequence

from icrl_dist.problems.checks import check_parameters
from icrl_dist.types import Spec, Task

KIND = "metaworld-pick-place"
HORIZON = 500
"""Steps per episode; Meta-World allows no more."""
DISTURBANCE = 0.01
"""Meters by which an adversary of strength 1 moves a component of hand, object or goal: the scripted policy
succeeds with 1 cm, and seldom with 2 cm (docs/decisions/046-meta-world.md)."""
MOVED = 9
"""Components of the adversary's action: x, y, z of hand, object and goal."""

_LOW = {"object": (-0.1, 0.6, 0.02), "goal": (-0.1, 0.8, 0.05)}
_HIGH = {"object": (0.1, 0.7, 0.02), "goal": (0.1, 0.9, 0.3)}
GOALS = _LOW["goal"], _HIGH["goal"]
"""Lowest and highest corner of the box of possible goals, in meters."""


def task(object: Sequence[float], goal: Sequence[float], **settings: object) -> Task:
    """The task with this initial position of the object and this goal, in meters.

    ``settings``: ``horizon``, steps; ``goal_shown``, 1 if observations contain the goal (for training
    experts); ``disturbance``, meters.  Raises ValueError as ``check`` does.
    """
    made = Task.of(KIND, object=object, goal=goal, **settings)
    check(made)
    return made


def check(task: Task) -> None:
    """Raises ValueError, with the value, unless the task is one of Meta-World's."""
    check_parameters(task, ("object", "goal"), ("horizon", "goal_shown", "disturbance"))
    for name in ("object", "goal"):
        place = task.vector(name)
        inside = len(place) == 3 and all(
            lo - 1e-6 <= x <= hi + 1e-6 for lo, x, hi in zip(_LOW[name], place, _HIGH[name], strict=True)
        )
        if not inside:
            raise ValueError(f"{KIND} {name}={place} lies outside its box: use {_LOW[name]} to {_HIGH[name]} meters")
    if not 1 <= horizon(task) <= HORIZON:
        raise ValueError(f"{KIND} horizon={horizon(task)}: expected 1 to {HORIZON} steps")
    if task.get("goal_shown", 0) not in (0, 1):
        raise ValueError(f"{KIND} goal_shown={task['goal_shown']!r}: expected 0 or 1")
    if not 0 <= disturbance(task) <= 0.1:
        raise ValueError(f"{KIND} disturbance={disturbance(task)}: expected 0 to 0.1 meters")


def horizon(task: Task) -> int:
    """Steps per episode."""
    return int(task.number("horizon")) if "horizon" in dict(task.params) else HORIZON


def disturbance(task: Task) -> float:
    """Meters by which an adversary of strength 1 moves a component of the observation."""
    return task.number("disturbance") if "disturbance" in dict(task.params) else DISTURBANCE


def spec(task: Task) -> Spec:
    """Spec: an observation has a frame of 18 numbers, the frame before, and the goal; an action has 4 components.

    A frame: position of the hand (3), gripper, position (3) and quaternion (4) of the object, and 7 zeros.
    """
    check(task)
    low = (-0.6, 0.3, -0.1, -1.0, -0.6, 0.3, -0.1, *(-1.0,) * 11)
    high = (0.6, 1.1, 0.8, 1.0, 0.6, 1.1, 0.8, *(1.0,) * 11)
    return Spec((*low, *low, -0.2, -0.1, -0.1), (*high, *high, 0.2, 1.0, 0.4), 4, horizon(task), discrete=False)
