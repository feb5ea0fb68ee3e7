"""Which tasks and which adversaries a run trains on, and which it keeps for the test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icrl_dist.config import Run
from icrl_dist.envs import darkroom
from icrl_dist.envs.adversary import adversary_set, sample_dirichlet
from icrl_dist.types import NULL, Adversary, Spec, Task, Variation

# Spawn keys of the draws that are not a trajectory's; a trajectory's begin with a stage number.
_SPLIT, _PRIORS, _UNSEEN = 101, 102, 103


@dataclass(frozen=True)
class Split:
    """A run's tasks, split by goal: ``train`` to learn from, ``test`` never learned from."""

    train: tuple[Task, ...]
    test: tuple[Task, ...]


def split(run: Run) -> Split:
    """All goals of the room, shuffled by ``darkroom.split_seed``, cut at ``train_fraction``."""
    room = run.darkroom
    goals = [(x, y) for x in range(room.size) for y in range(room.size)]
    order = np.random.default_rng(np.random.SeedSequence(room.split_seed, spawn_key=(_SPLIT,))).permutation(len(goals))
    tasks = [darkroom.task(goals[i], room.size, room.horizon) for i in order]
    cut = round(room.train_fraction * len(tasks))
    return Split(tuple(tasks[:cut]), tuple(tasks[cut:]))


def spec(run: Run) -> Spec:
    """The spec that all of a run's tasks share."""
    return darkroom.spec(split(run).train[0])


def deployed(task: Task) -> Task:
    """The task as it is met at test time: every episode starts in the origin (appendix C.1)."""
    return task.replace(start=(0, 0))


def variations(run: Run, index: int, task: Task, round: int = 0) -> tuple[Variation, ...]:
    """The K training variations of task number ``index``, phi_0 first (Algorithm 2, line 7).

    Every round of ICAA samples its adversaries anew (Algorithm 3, line 11).
    """
    rng = np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(_PRIORS, index, round)))
    adversaries = adversary_set(rng, run.adversary.count, darkroom.ACTIONS, run.adversary.p_max)
    return tuple(Variation(task, a) for a in adversaries)


def test_adversary(run: Run, index: int, p: float, prior: str) -> Adversary:
    """The disturbance of test task ``index`` at strength p: never one that was trained on.

    ``uniform``: q_b = 1/5, for the sweep over p (Figures 3c, 6c).  ``unseen``: a Dirichlet
    prior from a seed disjoint from the training priors' (Figures 3d, 6d).
    """
    if p == 0:
        return NULL
    if prior == "uniform":
        return Adversary.of("uniform", p=p)
    rng = np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(_UNSEEN, index)))
    return sample_dirichlet(rng, darkroom.ACTIONS, 1.0).replace(p=p)
