"""The jobs of a phase: pretraining contexts or rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from icrl_dist.collect.adapt import LabelledRollouts, Rollouts
from icrl_dist.config.run import Run
from icrl_dist.config.sections import Deployment
from icrl_dist.interfaces import Contexts, Phase
from icrl_dist.problems import registry
from icrl_dist.types import Job, Payload, Task, Variation

Choose = Callable[[int, Task], tuple[Variation, ...]]
"""The variations of training task number i."""


def pretraining_contexts(run: Run, phase: Phase, choose: Choose, contexts: Contexts | None = None) -> tuple[Job, ...]:
    """Algorithm 2, lines 4 to 14: for every task, contexts and labels in every variation.

    ``contexts``: how they are collected; None: as ``Problem.contexts`` says.

    The variations divide ``pretrain.contexts`` episodes among them, so all methods and all K get the same number.
    """
    problem = registry.of(run)
    chosen = [choose(i, task) for i, task in enumerate(problem.split.train)]
    trials = max(1, run.pretrain.contexts // sum(map(len, chosen)))
    contexts = problem.contexts(run) if contexts is None else contexts
    if contexts.most_trials is not None:
        trials = min(trials, contexts.most_trials)
    return grouped(run, phase, chosen, trials, contexts.payload)


def grouped(run: Run, phase: Phase, chosen: Sequence[tuple[Variation, ...]], trials: int, payload: Payload) -> tuple[Job, ...]:
    """Jobs of ``stream.job_tasks`` tasks each; ``chosen`` holds the variations of every task."""
    jobs = []
    for first in range(0, len(chosen), run.stream.job_tasks):
        group = chosen[first : first + run.stream.job_tasks]
        flat = tuple(v for variations in group for v in variations)
        jobs.append(
            Job(
                kind=payload.kind,
                stage=phase.stage,
                round=phase.round,
                task=first,
                variations=flat,
                trials=trials,
                policy_version=phase.policy_version,
                seed=run.seed,
                payload=payload,
                tasks=len(group),
            )
        )
    return tuple(jobs)


def rollouts(
    run: Run, phase: Phase, choose: Choose, trials: int, rule: Deployment, explore: float = 0.0, explore_from: int = 0
) -> tuple[Job, ...]:
    """Jobs that deploy T^j in every variation, without labels; episodes start as test episodes do.

    From trial ``explore_from`` on actions are random with probability ``explore``.
    """
    payload = Rollouts(run.context.max, rule, run.context.decoder, explore, explore_from)
    return grouped(run, phase, at_test_start(run, choose), trials, payload)


def labelled_rollouts(run: Run, phase: Phase, choose: Choose, rules: Sequence[Deployment], trials: int) -> tuple[Job, ...]:
    """Jobs that deploy T^j in every training variation and label query states as in D_pre.

    Episodes start as test episodes do.  Jobs take the deployment rules in turn, because each rule gives
    another kind of history.
    """
    payload = LabelledRollouts(run.context.max, rules[0], run.context.decoder, 0.0, 0, registry.of(run).labelling(run))
    jobs = grouped(run, phase, at_test_start(run, choose), trials, payload)
    return tuple(
        dataclasses.replace(job, payload=dataclasses.replace(payload, deploy=rules[(phase.round + number) % len(rules)]))
        for number, job in enumerate(jobs)
    )


def at_test_start(run: Run, choose: Choose) -> list[tuple[Variation, ...]]:
    """The variations of every training task; episodes start as test episodes do."""
    problem = registry.of(run)
    return [choose(i, problem.at_test_start(task)) for i, task in enumerate(problem.split.train)]
