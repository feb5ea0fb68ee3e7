"""Meta-World's ML1 pick-place with a bounded disturbance of the observation (appendix C.2).

Observations contain the disturbed positions of hand and object, and zeros instead of the goal, as in ML1.
Labels are computed from the true state, which includes the goal.
"""

from __future__ import annotations

import functools
import pickle
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from icrl_dist.copies import CopiedWhole
from icrl_dist.problems.checks import check_generators
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.dmc.suite import BROKEN, check_step, rendered
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import Step, Task, Variation

_HAND, _OBJECT, _GOAL = slice(0, 3), slice(4, 7), slice(36, 39)
_NOW, _BEFORE = slice(0, 18), slice(18, 36)


@functools.lru_cache(maxsize=8)
def ml1_tasks(count: int = 20, seed: int = 0) -> tuple[Task, ...]:
    """The first training tasks of ML1 with this seed.

    Raises ValueError for more than ML1's 50.
    """
    from metaworld import ML1

    make: Any = ML1  # untyped
    made = make("pick-place-v3", seed=seed).train_tasks
    if not 0 < count <= len(made):
        raise ValueError(f"metaworld: {count} tasks: ML1 has {len(made)}, use 1 to {len(made)}")
    vectors = [pickle.loads(one.data)["rand_vec"] for one in made[:count]]  # safe: ML1 pickled them in this process
    return tuple(pick_place.task(vector[:3].tolist(), vector[3:].tolist()) for vector in vectors)


def expert(truth: Float64[np.ndarray, "B S"]) -> Float32[np.ndarray, "B A"]:
    """Actions of Meta-World's scripted policy, clipped to [-1, 1]; ``truth``: true states including the goal."""
    from metaworld.policies import SawyerPickPlaceV3Policy

    policy = SawyerPickPlaceV3Policy()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Constant")  # a warning that actions need clipping
        return np.stack([np.clip(policy.get_action(row), -1.0, 1.0) for row in truth]).astype(np.float32)


class PickPlace(CopiedWhole):
    """B variation environments, each with its own object position, goal and adversary.

    The adversary is a function of the true state including the goal.  At strength 1 it moves the observed
    positions of hand, object and (if observations contain it) goal by at most ``disturbance`` meters per
    component, also in the first observation.  An observation's previous frame is the disturbed one.
    """

    def __init__(self, variations: Sequence[Variation]) -> None:
        """Raises ValueError if horizon, ``goal_shown`` or ``disturbance`` differ, or an adversary has other widths."""
        tasks = [v.task for v in variations]
        for one in tasks:
            pick_place.check(one)
        shapes = {(pick_place.horizon(one), one.get("goal_shown", 0), pick_place.disturbance(one)) for one in tasks}
        if len(shapes) != 1:
            raise ValueError(
                f"metaworld: one batch holds one horizon, goal_shown and disturbance, not {sorted(map(str, shapes))}"
            )
        self.spec, self.batch = pick_place.spec(tasks[0]), len(tasks)
        self._adversaries = Networks([v.adversary for v in variations], self.spec, pick_place.MOVED)
        self._meters = pick_place.disturbance(tasks[0])
        self._shows_goal = bool(tasks[0].get("goal_shown", 0))
        self._envs = [environment(one) for one in tasks]
        self._goals = np.array([one.vector("goal") for one in tasks])
        self._low, self._high = (np.array(bound, np.float32) for bound in (self.spec.low, self.spec.high))
        self._h = self.spec.horizon
        self._tasks = tasks
        self._truth: Float64[np.ndarray, "B S"] = np.zeros((self.batch, self.spec.observation))
        self.success = np.zeros(self.batch, bool)
        """Whether the object is within 7 cm of the goal."""

    @property
    def truth(self) -> Float64[np.ndarray, "B S"]:
        """The true states including the goals, for labels."""
        return self._truth.copy()

    def __getstate__(self) -> dict[str, Any]:
        """Meta-World's environments as ``_saved`` gives them: its own copies ignore actions."""
        return {**self.__dict__, "_envs": [_saved(env) for env in self._envs]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._envs = [_restored(*each) for each in zip(self._tasks, state["_envs"], strict=True)]

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row.  The initial state of a task is fixed, so nothing is rendered."""
        check_generators("metaworld", self.batch, rngs)
        self._truth = np.stack([env.reset()[0] for env in self._envs])
        self._truth[:, _GOAL] = self._goals
        self._h = 0
        self.success = np.zeros(self.batch, bool)
        self._diverged = np.zeros(self.batch, bool)
        self._shown, _ = self._show(None)
        return self._shown.copy()

    def step(self, actions: Float32[np.ndarray, "B A"]) -> Step:
        """Execute one action in every row; a simulation that diverges is not stepped any more.

        Raises ValueError for actions outside [-1, 1], RuntimeError past the horizon or before a reset.
        """
        check_step("metaworld", self.spec, self.batch, self._h, actions)
        self._h += 1
        reward = np.zeros(self.batch, np.float32)
        self.success = np.zeros(self.batch, bool)
        for row in np.flatnonzero(~self._diverged):
            state, state_reward, _, _, info = self._envs[row].step(actions[row])
            self._diverged[row] = self._envs[row].data.warning.number[BROKEN].any()
            if not self._diverged[row]:
                self._truth[row, :36], reward[row], self.success[row] = state[:36], state_reward, bool(info["success"])
        self._shown, moved = self._show(self._shown)
        return Step(self._shown.copy(), reward, self._h == self.spec.horizon, moved, self._diverged.copy())

    def image(self, row: int) -> UInt8[np.ndarray, "height width 3"]:
        """One row through a camera of Meta-World.  Raises RuntimeError if MuJoCo cannot render on this node."""
        env = self._envs[row]
        env.render_mode = "rgb_array"
        return rendered(env.render)

    def _show(self, before: Float32[np.ndarray, "B S"] | None) -> tuple[Float32[np.ndarray, "B S"], Float32[np.ndarray, "B F"]]:
        """Observations of the true states, and the adversaries' actions; ``before``: the previous observations."""
        shown = self._truth.astype(np.float32)
        moved = self._adversaries.act(shown)
        for place, part in ((_HAND, slice(0, 3)), (_OBJECT, slice(3, 6)), (_GOAL, slice(6, 9))):
            shown[:, place] += np.float32(self._meters) * moved[:, part]
        if not self._shows_goal:
            shown[:, _GOAL] = 0.0
        shown[:, _BEFORE] = shown[:, _NOW] if before is None else before[:, _NOW]
        return np.clip(shown, self._low, self._high), moved


def environment(task: Task) -> Any:
    """Meta-World's environment with the task's object position and goal."""
    from metaworld.envs import SawyerPickPlaceEnvV3
    from metaworld.types import Task as MetaWorldTask

    env = SawyerPickPlaceEnvV3()
    vector = np.array([*task.vector("object"), *task.vector("goal")])
    fields = {"env_cls": SawyerPickPlaceEnvV3, "rand_vec": vector, "partially_observable": True}
    env.set_task(MetaWorldTask(env_name="pick-place-v3", data=pickle.dumps(fields)))  # the only form that it accepts
    return env


_PADS = {"init_left_pad": "leftpad", "init_right_pad": "rightpad"}
"""Attributes of Meta-World's environment that are views of a body's present position, for all their names."""
_BOUND = ("model", "data", "mujoco_renderer", *_PADS)
"""Its attributes that belong to the memory of the simulation."""


def _saved(env: Any) -> tuple[dict[str, Any], Any]:
    """What a copy of Meta-World's environment needs: its other attributes, and the simulation with its model."""
    return {name: value for name, value in vars(env).items() if name not in _BOUND}, env.data


def _restored(task: Task, saved: tuple[dict[str, Any], Any]) -> Any:
    env = environment(task)
    attributes, data = saved
    env.__dict__.update(attributes)
    env.data, env.model = data, data.model
    for name, body in _PADS.items():
        setattr(env, name, env.get_body_com(body))
    env.mujoco_renderer.data, env.mujoco_renderer.model = data, data.model
    return env
