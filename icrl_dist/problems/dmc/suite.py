"""Observations and rewards of dm_control's six domains, for a whole batch of simulations together.

The formulas are those of ``dm_control.suite``, applied to arrays of all rows.  In dm_control a step
spends most of its time in indexing by name; here that is done once per batch.  Tests compare both,
step by step, with forces.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from dm_control.utils.rewards import tolerance
from jaxtyping import Float32, Float64, Int64, UInt8

from icrl_dist.arrays import short
from icrl_dist.problems.continuous.renderer import OFF, missing, mujoco
from icrl_dist.types import Spec

Array = Float64[np.ndarray, "B ..."]
BROKEN = [getattr(mujoco.mjtWarning, f"mjWARN_BADQ{of}").value for of in ("POS", "VEL", "ACC")]
"""MuJoCo's warnings when a simulation breaks down; MuJoCo then resets it."""
_XX, _XZ, _ZZ = 0, 2, 8  # indices in a flat rotation matrix


class Rows:
    """The data of B simulations with equally shaped models, by MuJoCo's names; a field is stacked when it is read."""

    def __init__(self, models: Sequence[mujoco.MjModel], data: Sequence[mujoco.MjData]) -> None:
        self.model = models[0]
        """The first model: the others have the same shape, but their own masses, frictions and positions."""
        self._models, self._data = models, data
        self._fields: dict[str, tuple[list[np.ndarray], np.ndarray, np.ndarray]] = {}
        self._numbers: dict[tuple[mujoco.mjtObj, str], int] = {}
        self._readings: dict[tuple[Any, ...], Int64[np.ndarray, " R"]] = {}

    def __call__(self, field: str) -> Array:
        """This field of ``MjData`` in every row, ``(B, ...)``.  The array is valid until the field is read again."""
        if field not in self._fields:
            views = [getattr(data, field) for data in self._data]
            stacked = np.stack(views)
            self._fields[field] = [view.reshape(-1) for view in views], stacked.reshape(-1), stacked
        flat, into, stacked = self._fields[field]
        np.concatenate(flat, out=into)
        return stacked

    def body(self, name: str) -> int:
        """Number of the body of this name."""
        return self._number(mujoco.mjtObj.mjOBJ_BODY, name)

    def geom(self, name: str) -> int:
        """Number of the geom of this name."""
        return self._number(mujoco.mjtObj.mjOBJ_GEOM, name)

    def sensor(self, *names: str) -> Array:
        """The readings of these sensors, concatenated."""
        if names not in self._readings:
            self._readings[names] = self._places([self._number(mujoco.mjtObj.mjOBJ_SENSOR, name) for name in names])
        return self("sensordata")[:, self._readings[names]]

    def sensors(self, *kinds: mujoco.mjtSensor) -> Array:
        """The readings of all sensors of these kinds, in the model's order."""
        if kinds not in self._readings:
            ids = np.flatnonzero(np.isin(self.model.sensor_type, [kind.value for kind in kinds]))
            self._readings[kinds] = self._places(ids.tolist())
        return self("sensordata")[:, self._readings[kinds]]

    def _number(self, kind: mujoco.mjtObj, name: str) -> int:
        if (kind, name) not in self._numbers:
            self._numbers[kind, name] = int(mujoco.mj_name2id(self.model, kind, name))
        return self._numbers[kind, name]

    def _places(self, sensors: Sequence[int]) -> Int64[np.ndarray, " R"]:
        first, size = self.model.sensor_adr, self.model.sensor_dim
        return np.concatenate([np.arange(first[i], first[i] + size[i], dtype=np.int64) for i in sensors])

    def sizes(self, geom: str) -> Array:
        """First size of a geom in every row."""
        number = self.geom(geom)
        return np.array([model.geom_size[number, 0] for model in self._models])


class Domain(NamedTuple):
    """The observation of one domain of the suite, and the reward of each of its tasks."""

    observe: Callable[[Rows], list[Array]]
    rewards: dict[str, Callable[[Rows], Array]]


def _flat(array: Array) -> Array:
    return array.reshape(len(array), -1)


def _cartpole_observation(rows: Rows) -> list[Array]:
    return [rows("qpos")[:, :1], rows("xmat")[:, 2, [_ZZ, _XZ]], rows("qvel")]


def _cartpole_reward(rows: Rows) -> Array:
    upright = (rows("xmat")[:, 2, _ZZ] + 1) / 2
    centered = (1 + tolerance(rows("qpos")[:, 0], margin=2)) / 2
    small_control = (4 + tolerance(rows("ctrl")[:, 0], margin=1, value_at_margin=0, sigmoid="quadratic")) / 5
    small_velocity = (1 + tolerance(rows("qvel")[:, 1], margin=5)) / 2
    return np.asarray(upright * small_control * small_velocity * centered)


def _planar_observation(rows: Rows) -> list[Array]:
    return [rows("qpos")[:, 1:], rows("qvel")]


def _speed(rows: Rows) -> Array:
    return rows.sensor("torso_subtreelinvel")[:, 0]


def _cheetah_reward(rows: Rows) -> Array:
    return _speed_reward(_speed(rows), 10.0, 10.0, 0.0)


def _speed_reward(speed: Array, least: float, margin: float, at_margin: float) -> Array:
    return np.asarray(
        tolerance(speed, bounds=(least, float("inf")), margin=margin, value_at_margin=at_margin, sigmoid="linear")
    )


def _hopper_observation(rows: Rows) -> list[Array]:
    return [*_planar_observation(rows), np.log1p(rows.sensor("touch_toe", "touch_heel"))]


def _standing(rows: Rows) -> Array:
    places = rows("xipos")
    return np.asarray(tolerance(places[:, rows.body("torso"), 2] - places[:, rows.body("foot"), 2], (0.6, 2)))


def _hopper_stand_reward(rows: Rows) -> Array:
    small_control = tolerance(rows("ctrl"), margin=1, value_at_margin=0, sigmoid="quadratic").mean(axis=1)
    return np.asarray(_standing(rows) * (small_control + 4) / 5)


def _hopper_hop_reward(rows: Rows) -> Array:
    return np.asarray(_standing(rows) * _speed_reward(_speed(rows), 2.0, 1.0, 0.5))


def _to_target(rows: Rows) -> Array:
    places = rows("geom_xpos")
    return places[:, rows.geom("target"), :2] - places[:, rows.geom("finger"), :2]


def _reacher_observation(rows: Rows) -> list[Array]:
    return [rows("qpos"), _to_target(rows), rows("qvel")]


def _reacher_reward(rows: Rows) -> Array:
    radii = rows.sizes("target") + rows.sizes("finger")
    return (np.linalg.norm(_to_target(rows), axis=1) <= radii).astype(np.float64)


def _walker_observation(rows: Rows) -> list[Array]:
    height = rows("xpos")[:, [rows.body("torso")], 2]
    return [_flat(rows("xmat")[:, 1:, [_XX, _XZ]]), height, rows("qvel")]


def _walker_reward(least: float) -> Callable[[Rows], Array]:
    def reward(rows: Rows) -> Array:
        torso = rows.body("torso")
        standing = tolerance(rows("xpos")[:, torso, 2], bounds=(1.2, float("inf")), margin=0.6)
        posture = (3 * standing + (1 + rows("xmat")[:, torso, _ZZ]) / 2) / 4
        return np.asarray(posture * (5 * _speed_reward(_speed(rows), least, least / 2, 0.5) + 1) / 6)

    return reward


def _quadruped_observation(rows: Rows) -> list[Array]:
    model, kind = rows.model, mujoco.mjtSensor
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE.value)
    return [
        rows("qpos")[:, model.jnt_qposadr[hinges]],
        rows("qvel")[:, model.jnt_dofadr[hinges]],
        rows("act"),
        rows.sensor("velocimeter"),
        rows("xmat")[:, [rows.body("torso")], _ZZ],
        rows.sensors(kind.mjSENS_GYRO, kind.mjSENS_ACCELEROMETER),
        np.arcsinh(rows.sensors(kind.mjSENS_FORCE, kind.mjSENS_TORQUE)),
    ]


def _quadruped_reward(least: float) -> Callable[[Rows], Array]:
    def reward(rows: Rows) -> Array:
        upright = _speed_reward(rows("xmat")[:, rows.body("torso"), _ZZ], 1.0, 2.0, 0.0)
        return np.asarray(upright * _speed_reward(rows.sensor("velocimeter")[:, 0], least, least, 0.5))

    return reward


DOMAINS: dict[str, Domain] = {
    "cartpole": Domain(_cartpole_observation, {"balance": _cartpole_reward, "swingup": _cartpole_reward}),
    "cheetah": Domain(_planar_observation, {"run": _cheetah_reward}),
    "hopper": Domain(_hopper_observation, {"stand": _hopper_stand_reward, "hop": _hopper_hop_reward}),
    "quadruped": Domain(_quadruped_observation, {"walk": _quadruped_reward(0.5), "run": _quadruped_reward(5.0)}),
    "reacher": Domain(_reacher_observation, {"easy": _reacher_reward, "hard": _reacher_reward}),
    "walker": Domain(_walker_observation, {"walk": _walker_reward(1.0), "run": _walker_reward(8.0)}),
}


def observed(rows: Rows, domain: str) -> Array:
    """The observation of every row: dm_control's dict, flattened in the dict's order."""
    return np.concatenate(DOMAINS[domain].observe(rows), axis=1)


def rendered(draw: Callable[[], np.ndarray]) -> UInt8[np.ndarray, "height width 3"]:
    """The image that ``draw`` renders with MuJoCo.  Raises RuntimeError, with the remedy, if it cannot on this node."""
    gl = os.environ.get("MUJOCO_GL", "")
    remedy = "set MUJOCO_GL=egl, or osmesa without a GPU, before Python starts, and install libegl1 or libosmesa6"
    if missing:
        raise RuntimeError(f"MuJoCo cannot render here ({missing[0]}): {remedy}")
    if gl in OFF:
        raise RuntimeError(f"MuJoCo cannot render here (MUJOCO_GL={gl!r}): {remedy}")
    try:
        return np.asarray(draw(), np.uint8)
    except Exception as error:  # each back end raises its own type
        raise RuntimeError(f"MuJoCo cannot render here (MUJOCO_GL={gl!r}: {' '.join(str(error).split())}): {remedy}") from None


def check_step(problem: str, spec: Spec, batch: int, done: int, actions: Float32[np.ndarray, "B A"]) -> None:
    """Raises RuntimeError if ``done`` steps reach the horizon, ValueError for actions outside [-1, 1]."""
    if done >= spec.horizon:
        raise RuntimeError(f"{problem}: stepped past the horizon of {spec.horizon}; call reset first")
    if actions.shape != (batch, spec.actions) or actions.dtype.kind != "f" or not np.abs(actions).max() <= 1:
        raise ValueError(f"{problem}: actions {short(actions)}: expected {batch} x {spec.actions} numbers in [-1, 1]")
