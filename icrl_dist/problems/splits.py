"""Which tasks and which adversaries a run trains on, and which it keeps for the test."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.problems.continuous.network_adversary import network, networks
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom.adversaries import adversary_set, sample_dirichlet
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import NULL, Adversary, Spec, Task, Variation

# Spawn keys of the draws that are not a trajectory's; a trajectory's begin with a stage number.
_SPLIT, _PRIORS, _UNSEEN = 101, 102, 103


@dataclass(frozen=True)
class Split:
    """A run's tasks, split by goal: ``train`` to learn from, ``test`` never learned from."""

    train: tuple[Task, ...]
    test: tuple[Task, ...]


def split(run: Run) -> Split:
    """Dark Room: all goals, shuffled by ``darkroom.split_seed``, cut at ``train_fraction``.

    DeepMind Control: the centre of the grid of parameters, and others of the grid; Meta-World:
    ML1's first tasks, and the next.
    """
    if run.problem != "darkroom":
        return _control_split(run)
    room = run.darkroom
    goals = [(x, y) for x in range(room.size) for y in range(room.size)]
    order = np.random.default_rng(np.random.SeedSequence(room.split_seed, spawn_key=(_SPLIT,))).permutation(len(goals))
    tasks = [darkroom.task(goals[i], room.size, room.horizon) for i in order]
    cut = round(room.train_fraction * len(tasks))
    return Split(tuple(tasks[:cut]), tuple(tasks[cut:]))


def _control_split(run: Run) -> Split:
    control, seed = run.control, run.darkroom.split_seed
    count, horizon = control.train_tasks, {"horizon": control.horizon} if control.horizon else {}
    if run.problem == pick_place.KIND:
        from icrl_dist.problems.metaworld.environment import ml1_tasks

        chosen = ml1_tasks(count + control.test_tasks, seed)
        chosen = tuple(task.replace(disturbance=control.disturbance, **horizon) for task in chosen)
        return Split(chosen[:count], chosen[count:])
    middle = domains.grid(run.problem, math.isqrt(count))
    others = [task for task in domains.grid(run.problem) if task not in middle]
    order = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_SPLIT,))).permutation(len(others))
    outer = [others[i] for i in order[: control.test_tasks]]
    train, test = (tuple(task.replace(forces=control.forces, **horizon) for task in part) for part in (middle, outer))
    return Split(train, test)


def spec(run: Run) -> Spec:
    """The spec that all of a run's tasks share."""
    if run.problem == pick_place.KIND:  # ML1 takes seconds to make its tasks
        place = {"object": (0.0, 0.6, 0.02), "goal": (0.0, 0.8, 0.1)}
        horizon = {"horizon": run.control.horizon} if run.control.horizon else {}
        return registry.spec(Task.of(pick_place.KIND, **place, **horizon))
    return registry.spec(split(run).train[0])


def deployed(task: Task) -> Task:
    """The task as it is met at test time: in Dark Room every episode starts in the origin (appendix C.1)."""
    return task.replace(start=(0, 0)) if task.kind == "darkroom" else task


def evaluated(run: Run) -> tuple[Task, ...]:
    """The tasks of online evaluation: those never learned from; in DeepMind Control, as in the paper
    (appendix D.4), those that its experts were trained in.
    """
    return split(run).train if run.problem.startswith("dmc-") else split(run).test


def disturbance(run: Run) -> int:
    """Components of the adversary's action in a continuous game."""
    if run.problem == pick_place.KIND:
        return pick_place.MOVED
    return domains.problem(run.problem).forces[run.control.forces].count


def variations(run: Run, index: int, task: Task, round: int = 0) -> tuple[Variation, ...]:
    """The K training variations of task number ``index``, phi_0 first (Algorithm 2, line 7).

    Every round of ICAA samples its adversaries anew (Algorithm 3, line 11).
    """
    rng = np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(_PRIORS, index, round)))
    if run.problem != "darkroom":
        pushes = networks(
            rng, run.adversary.count, spec(run), disturbance(run), calibrated_strength.strength(run.control, run.problem)
        )
        return tuple(Variation(task, one) for one in pushes)
    adversaries = adversary_set(rng, run.adversary.count, darkroom.ACTIONS, run.adversary.p_max)
    return tuple(Variation(task, a) for a in adversaries)


def test_adversary(run: Run, index: int, p: float, prior: str) -> Adversary:
    """The disturbance of test task ``index`` at strength p: never one that was trained on.

    ``uniform``: q_b = 1/5, for the sweep over p (Figures 3c, 6c).  ``unseen``: a Dirichlet
    prior from a seed disjoint from the training priors' (Figures 3d, 6d).  In a continuous game a
    network from such a seed, of strength p times ``control.strength``.
    """
    if p == 0:
        return NULL
    rng = np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(_UNSEEN, index)))
    if run.problem != "darkroom":
        seed = int(rng.integers(2**31))
        return network(
            seed, spec(run).observation, disturbance(run), p * calibrated_strength.strength(run.control, run.problem)
        )
    if prior == "uniform":
        return Adversary.of("uniform", p=p)
    return sample_dirichlet(rng, darkroom.ACTIONS, 1.0).replace(p=p)
