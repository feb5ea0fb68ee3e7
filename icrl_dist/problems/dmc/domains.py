"""The 11 problems of the DeepMind Control Suite (appendix C.3): forces, and grids of physical parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from icrl_dist.config.toml import nearest
from icrl_dist.problems.checks import check_parameters
from icrl_dist.types import Spec, Task

HORIZON = 200
"""Steps per episode (appendix C.3)."""
GRID = 8
"""Values of each parameter: the tasks form an 8x8 grid, and its central 4x4 are training tasks (appendix D.4)."""

Preset = Literal["paper", "qarl"]
"""Source of the adversary's forces: Table 2, or QARL's code, which has other bodies and some far larger forces."""

Component = tuple[str, str]
"""A body, and the axes of the force on it: x, y, z; or X, Y, Z for a torque about that axis."""
AXES = "xyzXYZ"
"""All axes in MuJoCo's order: three forces, three torques."""


@dataclass(frozen=True)
class Forces:
    """The forces that an adversary applies."""

    components: tuple[Component, ...]
    largest: float
    """Newtons (newton meters for a torque) for an adversary's action of 1."""

    @property
    def count(self) -> int:
        """Components of the adversary's action."""
        return sum(len(axes) for _, axes in self.components)


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of a task: a body's mass, or the friction of all geoms."""

    name: str
    low: float
    high: float
    body: str | None = None
    """The body whose mass it is; None for friction."""

    def grid(self) -> tuple[float, ...]:
        """The parameter's ``GRID`` values, evenly spaced."""
        return tuple(float(round(value, 9)) for value in np.linspace(self.low, self.high, GRID))


@dataclass(frozen=True)
class DomainTask:
    """One task of one domain of the suite, with the forces and parameters by which it is varied."""

    domain: str
    task: str
    forces: dict[Preset, Forces]
    parameters: tuple[Parameter, Parameter]
    actions: int
    """Components of the agent's action."""
    scale: tuple[float, ...]
    """Bound of each observation component's absolute value, which is seldom exceeded; observations are clipped to it."""


_CARTPOLE: dict[Preset, Forces] = {"paper": Forces((("pole_1", "xz"),), 0.005), "qarl": Forces((("pole_1", "xz"),), 2.0)}
_CHEETAH = Forces((("torso", "xz"), ("bfoot", "xz"), ("ffoot", "xz")), 1.0)
_HOPPER: dict[Preset, Forces] = {
    "paper": Forces((("torso", "xz"), ("foot", "xz")), 1.0),
    "qarl": Forces((("foot", "xz"),), 1.0),
}
_QUADRUPED: dict[Preset, Forces] = {"paper": Forces((("torso", "xyz"),), 10.0), "qarl": Forces((("torso", "xzY"),), 10.0)}
_REACHER = Forces((("arm", "xy"),), 0.1)
_WALKER = Forces((("right_foot", "xz"), ("left_foot", "xz")), 1.0)


def _friction(low: float, high: float) -> Parameter:
    return Parameter("friction", low, high)


def _both(forces: Forces) -> dict[Preset, Forces]:
    return {"paper": forces, "qarl": forces}


def _cartpole(task: str, low: float, high: float) -> DomainTask:
    masses = (Parameter("pole_mass", low, high, "pole_1"), Parameter("cart_mass", 0.5, 1.5, "cart"))
    return DomainTask("cartpole", task, _CARTPOLE, masses, 1, (2.0, 1.0, 1.0, 10.0, 20.0))


def _hopper(task: str) -> DomainTask:
    parameters = (Parameter("torso_mass", 1.0, 9.0, "torso"), _friction(0.1, 1.9))
    scale = (1.5, 8.0, 1.0, 3.0, 3.0, 1.0, 5.0, 10.0, *(30.0,) * 5, 10.0, 10.0)
    return DomainTask("hopper", task, _HOPPER, parameters, 4, scale)


def _quadruped(task: str) -> DomainTask:
    parameters = (Parameter("torso_mass", 65.0, 75.0, "torso"), _friction(0.95, 1.05))
    scale = (*(1.5,) * 16, *(20.0,) * 16, *(1.0,) * 12, *(8.0,) * 3, 1.0, *(200.0,) * 3, *(12.0,) * 3, *(10.0,) * 24)
    return DomainTask("quadruped", task, _QUADRUPED, parameters, 12, scale)


def _reacher(task: str) -> DomainTask:
    masses = (Parameter("arm_mass", 0.02, 0.06, "arm"), Parameter("hand_mass", 0.02, 0.05, "hand"))
    return DomainTask("reacher", task, _both(_REACHER), masses, 2, (15.0, 3.5, 0.5, 0.5, 15.0, 15.0))


def _walker(task: str) -> DomainTask:
    parameters = (Parameter("torso_mass", 5.0, 15.0, "torso"), _friction(0.1, 1.3))
    return DomainTask("walker", task, _both(_WALKER), parameters, 6, (*(1.0,) * 14, 2.0, 10.0, 10.0, 40.0, *(60.0,) * 6))


_CHEETAH_RUN = DomainTask(
    "cheetah",
    "run",
    _both(_CHEETAH),
    (Parameter("torso_mass", 3.0, 9.0, "torso"), _friction(0.1, 1.9)),
    6,
    (1.0, 7.0, *(1.5,) * 6, 15.0, 10.0, 15.0, *(35.0,) * 6),
)

PROBLEMS: dict[str, DomainTask] = {
    f"dmc-{problem.domain}-{problem.task}": problem
    for problem in (
        _cartpole("balance", 1.0, 20.0),
        _cartpole("swingup", 0.05, 0.15),
        _CHEETAH_RUN,
        *map(_hopper, ("stand", "hop")),
        *map(_quadruped, ("walk", "run")),
        *map(_reacher, ("easy", "hard")),
        *map(_walker, ("walk", "run")),
    )
}
"""All problems by name, which is the ``kind`` of their tasks."""


def problem(kind: str) -> DomainTask:
    """The problem of this name.  Raises ValueError, with the nearest name, for an unknown one."""
    if kind not in PROBLEMS:
        raise ValueError(f"task {kind!r}: no such problem{nearest(kind, tuple(PROBLEMS))}; known: {', '.join(PROBLEMS)}")
    return PROBLEMS[kind]


def task(kind: str, **settings: object) -> Task:
    """A task of this problem; a parameter that is not given has the suite's value.

    ``settings``: the problem's two parameters; ``horizon``, steps; ``forces``, a ``Preset``; ``mass``:
    ``rescaled``, a changed mass also changes the body's inertia, or ``qarl``, it does not.  Raises
    ValueError as ``check`` does.
    """
    made = Task.of(kind, **settings)
    check(made)
    return made


def check(task: Task) -> None:
    """Raises ValueError, with the value, unless the task is one of the problem's."""
    parameters = {one.name: one for one in problem(task.kind).parameters}
    choices = {"forces": ("paper", "qarl"), "mass": ("rescaled", "qarl")}
    check_parameters(task, (), (*parameters, "horizon", *choices))
    for name, value in task.params:
        if name in choices and value not in choices[name]:
            raise ValueError(f"{task.kind} {name}={value!r}: choose one of {', '.join(choices[name])}")
        if name in parameters:
            one, number = parameters[name], task.number(name)
            if not one.low <= number <= one.high:
                raise ValueError(f"{task.kind} {name}={number:g} lies outside its grid: use {one.low:g} to {one.high:g}")
    horizon = task.get("horizon", HORIZON)
    if not isinstance(horizon, int) or horizon < 1:
        raise ValueError(f"{task.kind} horizon={horizon!r}: expected a whole number of steps, at least 1")


def spec(task: Task) -> Spec:
    """Spec of the task; ``DomainTask.scale`` is the range of its observations."""
    check(task)
    one = problem(task.kind)
    horizon = int(task.number("horizon")) if "horizon" in dict(task.params) else HORIZON
    return Spec(tuple(-most for most in one.scale), one.scale, one.actions, horizon, discrete=False)


def grid(kind: str, central: int = GRID) -> tuple[Task, ...]:
    """The tasks of the central ``central`` x ``central`` part of the problem's grid; the second parameter varies fastest."""
    if not (0 < central <= GRID and (GRID - central) % 2 == 0):
        raise ValueError(f"grid of {central}x{central}: use an even number up to {GRID}, which has a center in {GRID}x{GRID}")
    one, other = problem(kind).parameters
    kept = slice((GRID - central) // 2, (GRID + central) // 2)
    return tuple(task(kind, **{one.name: a, other.name: b}) for a in one.grid()[kept] for b in other.grid()[kept])
