"""A problem of the DeepMind Control Suite as a ``Problem`` (appendix C.3)."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.ranges import remedy
from icrl_dist.experts.adversarial.payloads import RobustlyLabelledHistories
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.interfaces import Batch, Contexts, MakeDrawing, Reference
from icrl_dist.problems.continuous import robust
from icrl_dist.problems.continuous.problem import EXPERT, ContinuousProblem, experts_of, missing_experts
from icrl_dist.problems.dmc import domains
from icrl_dist.types import Spec, Split, Task, Variation

if TYPE_CHECKING:
    from icrl_dist.config.run import Run
    from icrl_dist.problems.benchmarks import Benchmarks
    from icrl_dist.problems.parts import TwoPlayerBatch

_TASKS = domains.GRID**2


class DMCProblem(ContinuousProblem):
    """One task of one domain, varied over a grid of two physical parameters."""

    template = "dmc"
    libraries = ("dm-control", "mujoco")

    def spec_of(self, task: Task) -> Spec:
        return domains.spec(task)

    @property
    def horizon(self) -> int:
        return self.config.horizon or domains.HORIZON

    @property
    def disturbances(self) -> int:
        return domains.problem(self.name).forces[self.config.forces].count

    def make_split(self) -> Split:
        """Training tasks: the center of the grid of parameters; test tasks: others of the grid, drawn with ``split_seed``."""
        of = self.config
        center = domains.grid(self.name, math.isqrt(of.train_tasks))
        others = [task for task in domains.grid(self.name) if task not in center]
        order = generator(of.split_seed, RandomKey.SPLIT).permutation(len(others))
        outer = [others[i] for i in order[: of.test_tasks]]
        horizon = {"horizon": of.horizon} if of.horizon else {}
        train, test = (tuple(task.replace(forces=of.forces, **horizon) for task in part) for part in (center, outer))
        return Split(train, test)

    @property
    def evaluated(self) -> tuple[Task, ...]:
        """The training tasks, as in the paper (appendix D.4)."""
        return self.split.train

    @property
    def evaluated_count(self) -> int:
        return self.train_count

    def batch(self, variations: Sequence[Variation]) -> Batch:
        from icrl_dist.problems.dmc.simulation import DMCVariations  # imported here because MuJoCo is slow to import

        return DMCVariations(variations)

    @property
    def second_player(self) -> ForcePlayer:
        """The adversary, which applies its forces."""
        return ForcePlayer(self)

    def robust_contexts(self, run: Run) -> Contexts:
        """DPT's contexts, labelled by the RARL policy of each task."""
        found, game = self.contexts(run), robust.game(self, run, curriculum=False)
        assert isinstance(found.payload, ExpertHistories)
        return Contexts(RobustlyLabelledHistories(found.payload.sac, found.payload.labelling, game), found.most_trials)

    def references(self, run: Run) -> dict[str, Reference]:
        """A random policy, and those of the undisturbed experts, RARL's and QARL's policies that are in this node's cache.

        Experts and policies are those of the evaluated tasks; RARL's and QARL's were trained against an adversary.
        """
        experts = experts_of(self, run)
        found = super().references(run) | ({} if experts is None else {EXPERT: Reference(experts, ceiling=True)})
        policies = {key: robust.policies_of(self, run, curriculum) for key, curriculum in robust.KEYS.items()}
        return found | {key: Reference(make) for key, make in policies.items() if make is not None}

    def missing_reference(self, run: Run, what: str) -> str:
        return missing_experts(self, run, what)

    def _own_objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        of, count = self.config, self.config.train_tasks
        if of.histories == "scripted":
            yield "control.histories", of.histories, "only Meta-World has a scripted policy"
        if count not in (4, 16, 36):
            yield "control.train_tasks", count, "use 4, 16 or 36: the tasks are the center of the grid"
        elif of.test_tasks > _TASKS - count:
            reason = "the grid has no more tasks besides the training tasks"
            yield "control.test_tasks", of.test_tasks, remedy(1, _TASKS - count, reason)

    def title(self, tasks: int) -> str:
        return f"{tasks} training tasks of {self.name}"

    @property
    def drawing(self) -> MakeDrawing:
        return functools.partial(_sticks, self.name)

    @property
    def benchmarks(self) -> Benchmarks:
        from icrl_dist.problems.dmc import bench

        return bench.benchmarks(self)


class ForcePlayer:
    """``Problem.second_player`` of a problem."""

    def __init__(self, problem: DMCProblem) -> None:
        self._problem = problem

    @property
    def strength(self) -> float:
        """Strength of its largest forces: that of training adversaries."""
        return self._problem.strength

    def batch(self, tasks: Sequence[Task], strength: float) -> TwoPlayerBatch:
        """These tasks; a force of 1 has this strength."""
        from icrl_dist.problems.dmc.simulation import DMCPlayers

        return DMCPlayers(tasks, strength)


def _sticks(name: str, states: np.ndarray, adversary: np.ndarray, task: Mapping[str, Any], every: int) -> dict[str, Any]:
    """A ``sticks`` drawing: ``frames`` of segments ``[x0, y0, x1, y1]`` in meters, ``frame_s`` apart, ``force`` in 0..1.

    ``travel``: how far the body has moved forward at each frame, in meters; ``ground``: height of the ground, or None.
    """
    components = len(domains.problem(name).scale)
    if states.shape[1] != components:
        raise ValueError(f"{states.shape[1]} observation components: {name} has {components}")
    from icrl_dist.problems.dmc import picture

    force = [round(float(value), 3) for value in np.minimum(adversary, 1.0)]
    frame_s, travel, ground = every * picture.step_s(name), picture.travel(name, states, every), picture.ground(name)
    drawn = {"frames": picture.sticks(name, states), "frame_s": frame_s, "travel": travel, "ground": ground, "force": force}
    return {"kind": "sticks", **drawn}
