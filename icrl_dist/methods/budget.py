"""What a training costs, computed from its run before it is trained, and how the costs of several runs differ."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry as problems


class Budget(NamedTuple):
    """The cost of one training, of all phases together.  The fields but the last two are columns of the result rows."""

    label_source: str | None
    """What the labels come from, as ``UsedLabels.source``; several in the order of the phases, with commas."""
    training_episodes: int
    """Episodes that are collected."""
    labelled_episodes: int | None
    """Those of them whose labels the fits use; at most so many where returns decide (``icaa.label_trials = "improved"``)."""
    environment_steps: int
    """Environment steps: of the episodes, of action windows, and of the training of experts that give demonstrations."""
    optimizer_steps: int
    """Those of the in-context model."""
    contexts: int
    """Contexts in all training batches; at most so many if ``optim.transitions`` limits them."""
    extra_steps: int
    """Smaller optimizer steps of other nets beside these: ``ardt.steps`` of ARDT's return nets, else 0."""


@functools.lru_cache(maxsize=256)
def of(run: Run) -> Budget:
    """The budget of a run as if no variation is left out and no expert comes from a cache.

    Of a fork it is that of a run with these settings from the beginning.  ``label_source`` and ``labelled_episodes`` are
    None if the method's jobs do not say what they label.
    """
    method, horizon = methods.of(run), problems.of(run).horizon
    sources: list[str] | None = []
    episodes = labelled = env_steps = steps = 0
    for phase in method.phases(run):
        steps += phase.steps
        for job in method.ask(run, phase):
            used, count = method.used_labels(run, phase, job), len(job.variations)
            episodes += count * job.trials
            env_steps += count * job.payload.env_steps(job.trials, horizon)
            if used is None:
                sources = None
            elif used.trials:
                labelled += count * used.trials
                if sources is not None:
                    sources.append(used.source)
    source = None if sources is None else ", ".join(dict.fromkeys(sources)) or "none"
    known = None if sources is None else labelled
    return Budget(source, episodes, known, env_steps, steps, steps * run.optim.batch, method.extra_steps(run))


class LabelBytes(NamedTuple):
    """What the labels of one training are made of and what is sent for them, as if no variation is left out.

    Computed from the jobs, as the budget, and not counted in a dataset: arrays only, without names and headers.
    """

    labels: int
    """Labelled states: query states of ``labelled_episodes``; every step where labels are own actions of a model or policy."""
    label_bytes: int
    """Bytes of these states and their labels, with actions and rewards of action windows."""
    sent_bytes: int
    """Bytes of all episodes that workers send to the learner, with their labels."""


@functools.lru_cache(maxsize=256)
def label_bytes(run: Run) -> LabelBytes | None:
    """Labels of a training and their bytes; None for a problem whose adversary's actions have no size that is known."""
    method, problem = methods.of(run), problems.of(run)
    spec = problem.spec_of(problem.split.train[0])
    if not spec.discrete:
        return None
    horizon, observation, number = problem.horizon, _FLOAT * spec.observation, _FLOAT
    episode = (horizon + 1) * observation + horizon * (_INT + number + _INT)  # observations, actions, rewards, adversary
    found = np.zeros(3, int)
    for phase in method.phases(run):
        for job in method.ask(run, phase):
            used, asked, count = method.used_labels(run, phase, job), job.payload.labels, len(job.variations)
            if used is None or asked is None:
                return None
            answer = asked.queries * (observation + number * spec.actions) + asked.window_steps * (_INT + number)
            own = asked.queries == 0 or used.source.endswith("actions")  # the actions of the episode itself
            labels, size = (horizon, horizon * (observation + _INT)) if own else (asked.queries, answer)
            found += count * np.array([used.trials * labels, used.trials * size, job.trials * (episode + answer)])
    return LabelBytes(*map(int, found))


_FLOAT, _INT = 4, 2
"""Bytes of the numbers in trajectories (``types.ARRAYS``): observations, rewards and labels; actions."""


def columns(run: Run) -> dict[str, object]:
    """The budget as columns of the result rows."""
    return {name: value for name, value in of(run)._asdict().items() if name not in ("contexts", "extra_steps")}


def split_seed(run: Run) -> int | None:
    """``split_seed`` of the run's problem; None if it has none that is a whole number of 64 bits."""
    found = getattr(problems.of(run).config, "split_seed", None)  # a plugin may give the name another meaning
    whole = isinstance(found, int | np.integer) and not isinstance(found, bool) and abs(int(found)) < 2**63
    return int(found) if whole else None  # type: ignore[arg-type]


COMPARED = {
    "training_seed": "seeds",
    "split_seed": "splits",
    "environment_steps": "environment steps",
    "labelled_episodes": "labelled episodes",
    "optimizer_steps": "optimizer steps",
}
"""The columns of the result rows that are equal in a fair comparison, with their names in messages."""


def differences(arms: Mapping[str, Sequence[Run | Mapping[str, object]]]) -> list[str]:
    """What differs between the arms of a comparison, a sentence each; empty if they can be compared.

    ``arms``: by the name of a method the runs of its trainings, or the columns of ``COMPARED`` of each training.
    """
    found = {name: [_compared(one) for one in trainings] for name, trainings in arms.items()}
    sentences = [sentence for column in COMPARED if (sentence := _difference(column, found))]
    if not sentences:  # equal seeds and equal splits may still be paired differently
        pairs = {name: sorted((str(one["training_seed"]), str(one["split_seed"])) for one in of) for name, of in found.items()}
        if len({tuple(of) for of in pairs.values()}) > 1:
            sentences = ["splits differ for the same seed: give all methods the same pairs of seed and split_seed"]
    return sentences


def _compared(training: Run | Mapping[str, object]) -> dict[str, object]:
    if not isinstance(training, Run):
        return {column: training[column] for column in COMPARED}
    every = {"training_seed": training.seed, "split_seed": split_seed(training), **columns(training)}
    return {column: every[column] for column in COMPARED}


def _difference(column: str, arms: Mapping[str, Sequence[Mapping[str, object]]]) -> str:
    """The sentence about one column; empty if all arms have the same values, each as often or, of a budget, at all."""
    values = {name: sorted((one[column] for one in trainings), key=_order) for name, trainings in arms.items()}
    if column not in ("training_seed", "split_seed"):
        values = {name: list(dict.fromkeys(of)) for name, of in values.items()}
    if len({tuple(of) for of in values.values()}) <= 1:
        return ""
    by_values: dict[tuple[object, ...], list[str]] = {}
    for name, of in values.items():
        by_values.setdefault(tuple(of), []).append(name)
    texts = (f"{', '.join(names)}: {', '.join(map(_text, of)) or 'no training'}" for of, names in by_values.items())
    return f"{COMPARED[column]} differ: {'; '.join(texts)}"


def _order(value: object) -> tuple[bool, float]:
    return value is None, float(value) if isinstance(value, int | float | np.number) else 0.0


def _text(value: object) -> str:
    return "not known" if value is None else f"{value:,}"
