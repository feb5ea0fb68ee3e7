"""The DeepMind Control Suite in batches, with an adversary that applies forces (appendix C.3).

Episodes start as in dm_control.  A step calls MuJoCo directly and ends as in dm_control, so that
observations belong to the new state; observations and rewards of the whole batch are computed
together (``suite.py``).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from icrl_dist.arrays import short
from icrl_dist.copies import CopiedWhole
from icrl_dist.problems.checks import check_generators
from icrl_dist.problems.continuous import renderer
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.continuous.renderer import mujoco
from icrl_dist.problems.dmc.domains import AXES, HORIZON, Preset, check, problem, spec
from icrl_dist.problems.dmc.suite import BROKEN, DOMAINS, Rows, check_step, observed, rendered
from icrl_dist.types import Step, Task, Variation


def suite_environment(kind: str) -> Any:
    """dm_control's environment of this problem, with the suite's parameters."""
    if not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = "disabled"  # must be set before dm_control is imported, which looks for a display
    suite = renderer.imported("dm_control.suite")
    one = problem(kind)
    return suite.load(one.domain, one.task, task_kwargs={"random": np.random.RandomState(0)})


class DMC(CopiedWhole):
    """B simulations of one problem, each with its own task; agent and adversary act simultaneously."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        """Raises ValueError for different problems, and for a parameter outside its grid."""
        shapes = {(one.kind, one.get("horizon", HORIZON), one.get("forces", "paper")) for one in tasks}
        if len(shapes) != 1:
            raise ValueError(f"dmc: one batch holds one problem, horizon and preset of forces, not {sorted(map(str, shapes))}")
        for one in tasks:
            check(one)
        self.spec, self.batch = spec(tasks[0]), len(tasks)
        self._problem = problem(tasks[0].kind)
        preset: Preset = "qarl" if tasks[0].get("forces", "paper") == "qarl" else "paper"
        self._forces = self._problem.forces[preset]
        self.disturbance = self._forces.count
        """Number of components of the adversary's action."""
        self._envs = [suite_environment(one.kind) for one in tasks]
        for env, one in zip(self._envs, tasks, strict=True):
            _vary(env.physics, one)
        self._view()
        self._wrenches = np.zeros((self.batch, *self._data[0].xfrc_applied.shape))
        components = [(self._rows.body(body), AXES.index(axis)) for body, axes in self._forces.components for axis in axes]
        self._bodies, self._axes = (np.array(places) for places in zip(*components, strict=True))
        self._substeps = round(self._envs[0].control_timestep() / self._models[0].opt.timestep)
        self._runge_kutta = self._models[0].opt.integrator == mujoco.mjtIntegrator.mjINT_RK4.value
        self._low, self._high = (np.array(bound, np.float32) for bound in (self.spec.low, self.spec.high))
        self._h = self.spec.horizon

    def _view(self) -> None:
        """Make what a step needs and no copy can hold: views of the simulations' memory, and functions."""
        self._models = [env.physics.model.ptr for env in self._envs]
        self._data = [env.physics.data.ptr for env in self._envs]
        self._rows = Rows(self._models, self._data)
        self._reward = DOMAINS[self._problem.domain].rewards[self._problem.task]
        views = ([data.ctrl for data in self._data], [data.xfrc_applied for data in self._data])
        self._each = list(zip(self._models, self._data, *views, strict=True))
        self._warnings = [data.warning.number for data in self._data]

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy has simulations of its own, and views of their memory: a copied view would not be one."""
        views = ("_models", "_data", "_rows", "_reward", "_each", "_warnings")
        return _unfilled, (), {name: value for name, value in self.__dict__.items() if name not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._view()

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row as in dm_control, with the row's generator."""
        check_generators("dmc", self.batch, rngs)
        for env, rng in zip(self._envs, rngs, strict=True):
            env.task.random.seed(int(rng.integers(2**32)))
            with env.physics.reset_context():
                env.task.initialize_episode(env.physics)
        self._h = 0
        self._diverged = np.zeros(self.batch, bool)
        self._shown = self._observe()
        return self._shown.copy()

    def step(self, actions: Float32[np.ndarray, "B A"], forces: Float32[np.ndarray, "B F"]) -> Step:
        """Execute the agent's and the adversary's action in every row; ``forces`` of 1 are the preset's largest force.

        A simulation that diverges is not stepped any more: until the end of the episode it has the same
        observation, reward 0 and ``diverged``.  Raises ValueError for actions outside [-1, 1],
        RuntimeError past the horizon or before a reset.
        """
        check_step("dmc", self.spec, self.batch, self._h, actions)
        self._wrenches[:, self._bodies, self._axes] = forces * self._forces.largest
        each = zip(self._each, actions, self._wrenches, self._diverged.tolist(), strict=True)
        for (model, data, control, applied), action, wrench, diverged in each:
            if not diverged:
                control[:] = action
                applied[:] = wrench
                self._advance(model, data)
        self._h += 1
        self._diverged |= np.stack(self._warnings)[:, BROKEN].any(axis=1)
        reward = np.where(self._diverged, 0.0, self._reward(self._rows)).astype(np.float32)
        self._shown = np.where(self._diverged[:, None], self._shown, self._observe())
        return Step(self._shown.copy(), reward, self._h == self.spec.horizon, forces.copy(), self._diverged.copy())

    def image(self, row: int) -> UInt8[np.ndarray, "height width 3"]:
        """One row through the suite's first camera.  Raises RuntimeError if MuJoCo cannot render on this node."""
        return rendered(lambda: self._envs[row].physics.render(240, 320, camera_id=0))

    def _advance(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Step as dm_control does: all quantities that depend on position and velocity are up to date before and after."""
        if self._runge_kutta:
            mujoco.mj_step(model, data, self._substeps)
        else:
            mujoco.mj_step2(model, data)
            if self._substeps > 1:
                mujoco.mj_step(model, data, self._substeps - 1)
        mujoco.mj_step1(model, data)

    def _observe(self) -> Float32[np.ndarray, "B S"]:
        return np.clip(observed(self._rows, self._problem.domain).astype(np.float32), self._low, self._high)


def _vary(physics: Any, task: Task) -> None:
    """Set the task's masses and friction in the compiled model.

    A new mass also scales the body's inertia, and MuJoCo's derived constants are updated; with
    ``mass = "qarl"`` neither happens, as in QARL's code.
    """
    model, data = physics.model.ptr, physics.data.ptr
    for parameter in problem(task.kind).parameters:
        if parameter.name not in dict(task.params):
            continue
        value = task.number(parameter.name)
        if parameter.body is None:
            model.geom_friction[:, 0] = value
            continue
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, parameter.body)
        if task.get("mass", "rescaled") == "rescaled":
            model.body_inertia[body] *= value / model.body_mass[body]
        model.body_mass[body] = value
    if task.get("mass", "rescaled") == "rescaled":
        seen = model.stat.extent, model.stat.center.copy()
        mujoco.mj_setConst(model, data)
        # It also computes these two anew, from the whole floor.  Cameras clip by them, and would clip the robot away.
        model.stat.extent, model.stat.center[:] = seen


def _unfilled() -> DMC:
    """A ``DMC`` before its copied state is set; called before dm_control is imported, also in another process."""
    os.environ.setdefault("MUJOCO_GL", "disabled")
    return DMC.__new__(DMC)


class DMCVariations(CopiedWhole):
    """B variation environments: simulations in which every row has its fixed adversary."""

    def __init__(self, variations: Sequence[Variation]) -> None:
        self.simulation = DMC([v.task for v in variations])
        self.spec, self.batch = self.simulation.spec, self.simulation.batch
        self._adversaries = Networks([v.adversary for v in variations], self.spec, self.simulation.disturbance)
        self._observation: Float32[np.ndarray, "B S"] | None = None

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row."""
        self._observation = self.simulation.reset(rngs)
        return self._observation.copy()

    def step(self, actions: Float32[np.ndarray, "B A"]) -> Step:
        """Execute one action in every row; the adversary acts on the same observation.  Raises as ``DMC.step`` does."""
        if self._observation is None:
            raise RuntimeError("dmc: call reset before the first step")
        step = self.simulation.step(actions, self._adversaries.act(self._observation))
        self._observation = step.observation.copy()
        return step

    def image(self, row: int) -> UInt8[np.ndarray, "height width 3"]:
        """One row through the suite's first camera.  Raises RuntimeError if MuJoCo cannot render on this node."""
        return self.simulation.image(row)


class DMCPlayers(CopiedWhole):
    """B simulations with the adversary's forces as the actions of a second player."""

    def __init__(self, tasks: Sequence[Task], strength: float) -> None:
        """``strength``: of a force of 1, as ``control.strength``."""
        self.simulation, self._strength = DMC(tasks), np.float32(strength)
        self.spec, self.batch, self.disturbance = self.simulation.spec, self.simulation.batch, self.simulation.disturbance

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row."""
        return self.simulation.reset(rngs)

    def step(self, actions: Float32[np.ndarray, "B A"], disturbances: Float32[np.ndarray, "B F"]) -> Step:
        """Execute both actions.  Raises ValueError for disturbances outside [-1, 1], and as ``DMC.step`` does."""
        if not np.abs(disturbances).max() <= 1:
            raise ValueError(f"dmc: disturbances {short(disturbances)}: expected numbers in [-1, 1]")
        return self.simulation.step(actions, disturbances * self._strength)
