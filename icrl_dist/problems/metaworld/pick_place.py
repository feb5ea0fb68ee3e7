"""Tasks of Meta-World's ML1 pick-place (appendix C.2): what they are, without its simulator."""

from __future__ import annotations

from collections.abc import Sequence

from icrl_dist.config.toml import nearest
from icrl_dist.types import Spec, Task

KIND = "metaworld-pick-place"
HORIZON = 500
"""Steps an episode: Meta-World allows no more."""
DISTURBANCE = 0.01
"""Metres that an adversary of strength 1 moves a component of hand, object or goal: with 1 cm the scripted
policy still succeeds, with 2 cm it seldom does (docs/decisions/046-meta-world.md)."""
MOVED = 9
"""Components of an adversary's action: hand, object and goal, x, y, z of each."""

_LOW = {"object": (-0.1, 0.6, 0.02), "goal": (-0.1, 0.8, 0.05)}
_HIGH = {"object": (0.1, 0.7, 0.02), "goal": (0.1, 0.9, 0.3)}
GOALS = _LOW["goal"], _HIGH["goal"]
"""The box that goals lie in, in metres."""


def task(object: Sequence[float], goal: Sequence[float], **settings: object) -> Task:
    """The task in which the object lies here and has to go there, in metres.

    ``settings``: ``horizon``, steps; ``goal_shown``, 1 to show the agent the goal (an expert's
    environment); ``disturbance``, metres.  Raises ValueError as ``check`` does.
    """
    made = Task.of(KIND, object=object, goal=goal, **settings)
    check(made)
    return made


def check(task: Task) -> None:
    """Raises ValueError, naming the value, unless the task is one of Meta-World's."""
    known = ("object", "goal", "horizon", "goal_shown", "disturbance")
    for name, _ in task.params:
        if name not in known:
            raise ValueError(f"{KIND}: no parameter {name!r}{nearest(name, known)}; there are {', '.join(known)}")
    for name in ("object", "goal"):
        place = task.vector(name)
        inside = len(place) == 3 and all(
            lo - 1e-6 <= x <= hi + 1e-6 for lo, x, hi in zip(_LOW[name], place, _HIGH[name], strict=True)
        )
        if not inside:
            raise ValueError(f"{KIND} {name}={place} lies outside its box: use {_LOW[name]} to {_HIGH[name]} metres")
    if not 1 <= horizon(task) <= HORIZON:
        raise ValueError(f"{KIND} horizon={horizon(task)}: expected 1 to {HORIZON} steps")
    if task.get("goal_shown", 0) not in (0, 1):
        raise ValueError(f"{KIND} goal_shown={task['goal_shown']!r}: expected 0 or 1")
    if not 0 <= disturbance(task) <= 0.1:
        raise ValueError(f"{KIND} disturbance={disturbance(task)}: expected 0 to 0.1 metres")


def horizon(task: Task) -> int:
    """Steps an episode."""
    return int(task.number("horizon")) if "horizon" in dict(task.params) else HORIZON


def disturbance(task: Task) -> float:
    """Metres that an adversary of strength 1 moves a component."""
    return task.number("disturbance") if "disturbance" in dict(task.params) else DISTURBANCE


def spec(task: Task) -> Spec:
    """Shape: a frame of 18 numbers, the one before, and the goal's place; four actions.

    A frame: hand (3), gripper, object's place (3) and quaternion (4), and 7 that stay 0.
    """
    check(task)
    low = (-0.6, 0.3, -0.1, -1.0, -0.6, 0.3, -0.1, *(-1.0,) * 11)
    high = (0.6, 1.1, 0.8, 1.0, 0.6, 1.1, 0.8, *(1.0,) * 11)
    return Spec((*low, *low, -0.2, -0.1, -0.1), (*high, *high, 0.2, 1.0, 0.4), 4, horizon(task), discrete=False)
