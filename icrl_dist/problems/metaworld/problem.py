"""Meta-World's ML1 pick-place as a ``Problem`` (appendix C.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float, Float32

from icrl_dist.config.ranges import remedy
from icrl_dist.experts.payloads import ScriptedContexts
from icrl_dist.interfaces import Batch, Contexts, JobKind, MakeDrawing, Policy, Problem, Progress, Reference
from icrl_dist.problems.continuous.problem import SCRIPTED, ContinuousProblem
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import Job, Spec, Split, Task, Trajectory, Variation

if TYPE_CHECKING:
    from icrl_dist.config.run import Run
    from icrl_dist.problems.benchmarks import Benchmarks

_TASKS = 50
"""Number of ML1's training tasks."""
_HAND, _OPENING, _OBJECT = slice(0, 3), 3, slice(4, 7)
"""Components of the observation with x and y of hand and object."""


def _scripted_context(job: Job, problem: Problem, worker: str, progress: Progress) -> Iterator[Trajectory]:
    from icrl_dist.problems.metaworld.scripted_contexts import scripted_context  # imported here because it imports torch

    return scripted_context(job, problem, worker, progress)


class MetaWorldProblem(ContinuousProblem):
    """The agent must carry an object to a hidden goal; an adversary disturbs the observation."""

    template: ClassVar[str] = ""
    rewards: ClassVar[tuple[float, float]] = (-1.0, 11.0)  # shaped, between 0 and 10
    libraries: ClassVar[tuple[str, ...]] = ("metaworld", "mujoco")
    job_kinds: ClassVar[Mapping[str, JobKind]] = {ScriptedContexts.kind: JobKind(ScriptedContexts, _scripted_context)}

    def spec_of(self, task: Task) -> Spec:
        return pick_place.spec(task)

    @property
    def horizon(self) -> int:
        return self.config.horizon or pick_place.HORIZON

    @property
    def spec(self) -> Spec:  # does not need ML1, which takes seconds to create its tasks
        positions = {"object": (0.0, 0.6, 0.02), "goal": (0.0, 0.8, 0.1)}
        return self.spec_of(Task.of(pick_place.KIND, **positions, horizon=self.horizon))

    @property
    def disturbances(self) -> int:
        return pick_place.MOVED

    def make_split(self) -> Split:
        """Training tasks: the first of ML1's tasks, in its order for ``split_seed``; test tasks: the next ones."""
        from icrl_dist.problems.metaworld.environment import ml1_tasks

        of = self.config
        chosen = ml1_tasks(of.train_tasks + of.test_tasks, of.split_seed)
        horizon = {"horizon": of.horizon} if of.horizon else {}
        chosen = tuple(task.replace(disturbance=of.disturbance, **horizon) for task in chosen)
        return Split(chosen[: of.train_tasks], chosen[of.train_tasks :])

    def batch(self, variations: Sequence[Variation]) -> Batch:
        from icrl_dist.problems.metaworld.environment import PickPlace  # imported here because MuJoCo is slow to import

        return PickPlace(variations)

    def contexts(self, run: Run) -> Contexts:
        """Episodes of the scripted policy or histories of SAC experts; see ``control.histories``."""
        if self.config.histories == "scripted":
            return Contexts(ScriptedContexts(self.labelling(run)))
        return super().contexts(run)

    def references(self, run: Run) -> dict[str, Reference]:
        """A random policy, and the scripted policy, which is given the true state including the goal."""
        from icrl_dist.experts.train import ScriptedPolicy

        def scripted(rows: Sequence[Variation], env: Batch) -> Policy:
            return ScriptedPolicy(self, env)

        return super().references(run) | {SCRIPTED: Reference(scripted, ceiling=True)}

    @property
    def scripted(self) -> Callable[[Float[np.ndarray, "N T"]], Float32[np.ndarray, "N A"]]:
        """Meta-World's scripted policy; the true states contain the goal."""
        from icrl_dist.problems.metaworld.environment import expert

        return expert

    def _own_objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        of = self.config
        if of.train_tasks + of.test_tasks > _TASKS:
            yield self._too_many_tasks()
        if of.horizon > pick_place.HORIZON:
            yield "control.horizon", of.horizon, remedy(0, pick_place.HORIZON, "Meta-World allows no more steps")
        if isinstance(of.strength, str) and of.disturbance == 0:
            yield (
                "control.disturbance",
                of.disturbance,
                "use a distance above 0 if control.strength is drop:SHARE",
            )
        if run.method == "experts" and of.histories == "scripted":
            yield "control.histories", of.histories, "use sac: the method experts trains SAC experts"

    def _too_many_tasks(self) -> tuple[str, object, str]:
        """The objection to the larger of the numbers of training and test tasks, whose sum is above ML1's number of tasks."""
        counts = {f"control.{name}": getattr(self.config, name) for name in ("train_tasks", "test_tasks")}
        more, fewer = sorted(counts, key=lambda name: -counts[name])
        reason = f"ML1 has {_TASKS} tasks, for training and test together, and {fewer} = {counts[fewer]}"
        if counts[fewer] < _TASKS:
            return more, counts[more], remedy(1, _TASKS - counts[fewer], reason)
        return more, counts[more], remedy(1, 1, f"{reason}, which must also be at most {_TASKS - 1}")

    @property
    def drawing(self) -> MakeDrawing:
        return _arm

    @property
    def benchmarks(self) -> Benchmarks:
        from icrl_dist.problems.metaworld import bench

        return bench.benchmarks()


def _arm(states: np.ndarray, adversary: np.ndarray, task: Mapping[str, Any], every: int) -> dict[str, Any]:
    """An ``arm`` drawing: ``hand``, ``object`` and ``goal`` as ``[x, y, z]`` in meters, ``opening`` (0 to 1) of the gripper."""
    goal = task.get("goal")
    if not isinstance(goal, (list, tuple)) or len(goal) != 3 or not all(type(c) in (int, float) for c in goal):
        raise ValueError("not an episode of pick-place")
    if states.shape[1] < 7 or not np.isfinite(goal).all():
        raise ValueError("not an episode of pick-place")
    drawn = {"hand": _HAND, "object": _OBJECT}
    points = {name: [_rounded(point) for point in states[:, place]] for name, place in drawn.items()}
    return {"kind": "arm", **points, "opening": _rounded(states[:, _OPENING].clip(0, 1)), "goal": _rounded(np.array(goal))}


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 3) for value in values]
