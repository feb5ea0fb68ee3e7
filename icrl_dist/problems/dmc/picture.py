"""Stick figures of DeepMind Control: MuJoCo's kinematics compute the limbs' positions from observations."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from icrl_dist.problems.continuous.renderer import mujoco
from icrl_dist.problems.dmc.domains import problem
from icrl_dist.problems.dmc.simulation import suite_environment

_CAPSULE, _BOX, _ELLIPSOID = (getattr(mujoco.mjtGeom, f"mjGEOM_{kind}").value for kind in ("CAPSULE", "BOX", "ELLIPSOID"))
_TARGET_ARM = 0.03
"""Half the width of the cross at reacher's target, in meters."""


def sticks(kind: str, states: Float32[np.ndarray, "F S"]) -> list[list[list[float]]]:
    """F observations of a problem as frames, each a list of segments ``[x0, y0, x1, y1]`` in meters.

    The view is from the side; for reacher and quadruped from above.  Observations do not contain the
    position of the body, so the figure does not move forward; ``travel`` says how far it has.
    """
    figure = _figure(kind)
    return [figure.frame(state) for state in states.astype(np.float64)]


def travel(kind: str, states: Float32[np.ndarray, "F S"], every: int) -> list[float]:
    """How far the body has moved forward at each of F observations, ``every`` steps apart, in meters.

    Observations contain the body's velocity, and not its position, so this is the sum of the velocities.  Empty for a
    body that does not travel.  For quadruped, forward is where its torso points.
    """
    figure = _figure(kind)
    if figure.velocity is None:
        return []
    moved = states[:, figure.velocity].astype(np.float64) * every * figure.step_s
    found: list[float] = np.concatenate([[0.0], np.cumsum((moved[1:] + moved[:-1]) / 2)]).round(3).tolist()
    return found


def ground(kind: str) -> float | None:
    """The height of the ground in the drawing, in meters; None for a view from above, and for a cart on a rail."""
    return 0.0 if _figure(kind).walks else None


def step_s(kind: str) -> float:
    """Simulated seconds between two steps of a problem."""
    return _figure(kind).step_s


@functools.lru_cache(maxsize=16)
def _figure(kind: str) -> Figure:
    return Figure(kind)


class Figure:
    """The limbs of one problem's body."""

    def __init__(self, kind: str) -> None:
        self._env: Any = suite_environment(kind)  # keeps the model alive
        self._model, self._domain = self._env.physics.model.ptr, problem(kind).domain
        self._data = mujoco.MjData(self._model)
        self.step_s: float = self._env.control_timestep()
        moving = self._model.geom_bodyid > 0
        limbs = np.isin(self._model.geom_type, (_CAPSULE, _BOX, _ELLIPSOID)) & moving
        self._geoms = np.flatnonzero(limbs)
        capsule = self._model.geom_type[self._geoms] == _CAPSULE
        self._half = np.where(capsule, self._model.geom_size[self._geoms, 1], self._model.geom_size[self._geoms, 0])
        self._along = np.where(capsule, 2, 0)  # a capsule's axis is its own z
        self.walks = self._domain in ("cheetah", "hopper", "walker")
        self.velocity: int | None = self._forward()
        """The component of an observation that is the velocity forward, in meters a second; None for a body that stays."""
        self._view = [0, 1] if self._domain in ("reacher", "quadruped") else [0, 2]

    def _forward(self) -> int | None:
        if not self.walks and self._domain != "quadruped":
            return None
        first = 0
        for name, value in self._env.observation_spec().items():
            if name == "torso_velocity":
                return first
            if name == "velocity":  # qvel
                return first + int(self._model.jnt_dofadr[self._model.joint("rootx").id])
            first += int(np.prod(value.shape, dtype=int))
        raise AssertionError

    def frame(self, state: Float[np.ndarray, " S"]) -> list[list[float]]:
        """The segments of one observation."""
        data = self._data
        data.qpos[:] = self._positions(state)
        mujoco.mj_kinematics(self._model, data)
        middle = data.geom_xpos[self._geoms]
        axes = data.geom_xmat[self._geoms].reshape(-1, 3, 3)[np.arange(len(self._geoms)), :, self._along]
        reach = axes * self._half[:, None]
        ends = np.concatenate([(middle - reach)[:, self._view], (middle + reach)[:, self._view]], axis=1)
        if self._domain == "reacher":
            ends = np.concatenate([ends, self._target(state)])
        rounded: list[list[float]] = ends.round(3).tolist()
        return rounded

    def _positions(self, state: Float[np.ndarray, " S"]) -> Float[np.ndarray, " Q"]:
        """qpos of an observation; joints that it does not contain have the model's default."""
        qpos = self._model.qpos0.copy()
        if self._domain == "cartpole":
            qpos[:] = state[0], np.arctan2(state[2], state[1])
        elif self._domain == "reacher":
            qpos[:] = state[:2]
        elif self._domain in ("cheetah", "hopper"):
            qpos[1:] = state[: len(qpos) - 1]
        elif self._domain == "walker":
            qpos[0] = state[14] - self._model.body("torso").pos[2]
            absolute = np.arctan2(state[1:14:2], state[0:14:2])
            qpos[2] = absolute[0]
            parents = self._model.body_parentid[2:] - 1
            qpos[3:] = absolute[parents] - absolute[1:]  # these joints rotate about -y
        else:
            hinges = self._model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE.value
            qpos[self._model.jnt_qposadr[hinges]] = state[: hinges.sum()]
        return qpos

    def _target(self, state: Float[np.ndarray, " S"]) -> Float[np.ndarray, "2 4"]:
        """A cross at the target of reacher's finger."""
        x, y = self._data.geom_xpos[self._model.geom("finger").id][:2] + state[2:4]
        return np.array([[x - _TARGET_ARM, y, x + _TARGET_ARM, y], [x, y - _TARGET_ARM, x, y + _TARGET_ARM]])
