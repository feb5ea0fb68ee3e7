"""Find a problem by name, and create variation environments: ``make`` for one, ``batch`` for many."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl_dist import arrays
from icrl_dist.config import plugins
from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.interfaces import Batch, Problem
from icrl_dist.types import NULL, Adversary, Spec, Task, Variation

if TYPE_CHECKING:
    from icrl_dist.problems.gym_adapter import VariationEnv


def names() -> tuple[str, ...]:
    """The names of all problems, sorted; they are the ``kind`` of their tasks."""
    return plugins.names("problems")


@functools.lru_cache(maxsize=64)
def problem(name: str, config: Any = None) -> Problem:
    """The problem of this name; ``config``: its section of a run file, by default with default values.

    Raises ConfigError, with the nearest name, for an unknown name.
    """
    owner = plugins.find("problems", name)
    made: Problem = owner(name, owner.Config() if config is None else config)
    return made


def of(run: Run) -> Problem:
    """The problem of a run.  Runs with equal sections share the object, so its split is computed once."""
    return problem(run.problem, run.section(plugins.find("problems", run.problem).section))


def of_task(task: Task) -> Problem:
    """The problem of a task, with a default section.  Raises ValueError, with the nearest name, for an unknown one."""
    try:
        return problem(task.kind)
    except ConfigError as error:
        raise ValueError(f"task {task.kind!r}: no such {error}") from None


def batch(variations: Sequence[Variation]) -> Batch:
    """The variations as one batch, with a default section; where there is a run, use the ``batch`` of its problem.

    Raises ValueError for an unknown problem or a mixed batch, TypeError for what is no variation.
    """
    if isinstance(variations, Variation) or not all(isinstance(one, Variation) for one in variations):
        raise TypeError(f"batch: {arrays.short(variations)}: expected a list of Variation(task, adversary)")
    kinds = sorted({v.task.kind for v in variations})
    if len(kinds) != 1:
        raise ValueError(f"a batch holds variations of one problem, not {kinds}")
    return of_task(variations[0].task).batch(variations)


def spec(task: Task) -> Spec:
    """Spec of the task's observations and actions, with a default section."""
    return of_task(task).spec_of(task)


def make(variation: Variation, render_mode: str | None = None) -> VariationEnv:
    """The environment (tau, phi) of ``variation`` as a ``gymnasium.Env``; ``render_mode="rgb_array"``: it can render images.

    The problem has a default section: a problem whose environments depend on more than the task needs ``Problem.batch``.
    The adversary is part of the environment: observations contain neither it nor its action, but
    ``info["adversary"]`` has the action (see ``Step.adversary``).

    Observations are float32 ``(S,)`` in the environment's unit, actions integers or float32 vectors ``(A,)`` in [-1, 1].
    Raises ValueError, with the nearest name, for an unknown problem, parameter or adversary, and for another
    ``render_mode``; TypeError for what is no variation.
    """
    if not isinstance(variation, Variation) or not isinstance(variation.task, Task):
        raise TypeError(f"make: {arrays.short(variation)}: expected Variation(task, adversary)")
    from icrl_dist.problems.gym_adapter import VariationEnv

    return VariationEnv(variation, batch([variation]), render_mode)


def training_variations(run: Run, index: int, task: Task, round: int = 0) -> tuple[Variation, ...]:
    """The training variations of task number ``index`` (Algorithm 2, line 7): first phi_0 if ``adversary.null``, then K others.

    Each round of ICAA samples new adversaries (Algorithm 3, line 11).
    """
    rng = generator(run.seed, RandomKey.TRAINING_ADVERSARIES, index, round)
    return tuple(Variation(task, one) for one in adversaries(run, rng))


def adversaries(run: Run, rng: np.random.Generator) -> tuple[Adversary, ...]:
    """The adversaries of one training task: first phi_0 if ``adversary.null``, then K disturbances drawn with ``rng``."""
    return (NULL,) * run.adversary.null + of(run).training_adversaries(rng, run.adversary)


def test_adversary(run: Run, index: int, p: float, prior: str, draw: int = 0) -> Adversary:
    """An adversary of test task number ``index`` with strength ``p``; it is not one of training.

    ``draw``: number of the adversary draw; every evaluation of a task has its own.  A prior with a single adversary
    gives the same for each.
    """
    if p == 0:
        return NULL
    key = (index, draw) if draw else (index,)  # draw 0 has the key that a task's only adversary had in older versions
    return of(run).test_adversary(generator(run.seed, RandomKey.TEST_ADVERSARIES, *key), p, prior)
