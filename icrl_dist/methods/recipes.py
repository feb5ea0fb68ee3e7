"""The in-context methods side by side: what each asks for, and what it learns from.

They share the model and the loss of eq. (1).  A run goes through phases; in each, the
learner hands out the jobs that ``ask`` names, and fits the model to what ``learn`` makes of
the trajectories.  The phase after which T^j exists produces weights version j.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from icrl_dist.config.run import Deployment, Run, default_deployment
from icrl_dist.experts import cache
from icrl_dist.problems import splits
from icrl_dist.training.batches import Examples, LabelledWindows, Pool, Shelf, Shelved
from icrl_dist.types import Job, Params, Task, Trajectory, Variation


@dataclass(frozen=True)
class Phase:
    """Collect, then fit: one pass through the loop that all methods share."""

    stage: str
    round: int
    steps: int
    """Optimizer steps of the fit."""
    learning_rate: float
    """Peak learning rate of the fit."""

    @property
    def policy_version(self) -> int:
        """Version of the weights that act: T^j in round j of ``adapt``, none in ``pretrain``."""
        return self.round if self.stage == "adapt" else -1

    @property
    def next_version(self) -> int:
        """Version of the weights after the fit: 0 after ``pretrain``, j + 1 after round j."""
        return self.policy_version + 1


Key = tuple[str, int, int, int]
"""A variation's place in the dataset: stage, round, task, variation."""


class Dataset(Protocol):
    """The trajectories collected so far."""

    def variations(self, stage: str, round: int) -> Sequence[Key]:
        """Those of one stage and round, in canonical order."""
        ...

    def trials(self, key: Key) -> list[Trajectory]:
        """The trajectories of one variation, in order of trial."""
        ...


@dataclass(frozen=True)
class Method:
    """A pair of functions, and the phases they are called for."""

    phases: Callable[[Run], tuple[Phase, ...]]
    ask: Callable[[Run, Phase], tuple[Job, ...]]
    learn: Callable[[Run, Phase, Dataset], tuple[Pool, ...]]
    variations: Callable[[Run, int, Task, int], tuple[Variation, ...]]
    """Those of task number i that a round trains on."""


def _pretrain_only(run: Run) -> tuple[Phase, ...]:
    return (Phase("pretrain", 0, run.pretrain.steps, run.optim.learning_rate),)


def _then_dagger(run: Run) -> tuple[Phase, ...]:
    rounds = (Phase("adapt", j, run.dagger.steps, run.dagger.learning_rate) for j in range(run.dagger.rounds))
    return (*_pretrain_only(run), *rounds)


def _labelling(run: Run) -> Params:
    """What a collector must know to label queries."""
    room = run.darkroom
    goals = (task.vector("goal") for task in splits.split(run).train)
    decoy_fraction: Params = (
        ("decoys", tuple(int(x) * room.size + int(y) for x, y in goals)),
        ("decoy_fraction", run.pretrain.decoy_fraction),
    )
    return (
        *(decoy_fraction if run.pretrain.windows else ()),
        ("gamma", room.gamma),
        ("labels", room.labels),
        ("queries", run.pretrain.queries),
        ("slack", room.label_slack),
        ("window", run.model.window),
        ("windows", run.pretrain.windows),
    )


def _of_histories(run: Run) -> Params:
    """The same in a continuous game."""
    return (
        ("decoy_fraction", run.pretrain.decoy_fraction),
        ("queries", run.pretrain.queries),
        ("window", run.model.window),
        ("windows", run.pretrain.windows),
    )


def _random_contexts(run: Run, phase: Phase, variations: Callable[[int, Task], tuple[Variation, ...]]) -> tuple[Job, ...]:
    """Algorithm 2, lines 4 to 14: for every task, contexts and labels in every variation.

    All methods and all K share out the same ``pretrain.contexts`` episodes.  In a continuous game
    contexts are histories of SAC experts, or of Meta-World's scripted policy: of an expert's no more
    episodes than its training has.
    """
    if run.problem == "darkroom":
        kind, settings = "random_context", (("behaviors", ",".join(run.pretrain.behaviors)), *_labelling(run))
    else:
        kind, settings = "train_expert", (*_of_histories(run), *cache.settings(run.sac))
        if run.control.histories == "scripted":
            kind, settings = "scripted_context", _of_histories(run)
    chosen = [variations(i, task) for i, task in enumerate(splits.split(run).train)]
    trials = max(1, run.pretrain.contexts // sum(map(len, chosen)))
    if kind == "train_expert":
        trials = min(trials, cache.episodes(chosen[0][0].task, run.sac))
    return _jobs(run, phase, kind, chosen, trials, settings)


def _jobs(
    run: Run, phase: Phase, kind: str, chosen: Sequence[tuple[Variation, ...]], trials: int, settings: Params
) -> tuple[Job, ...]:
    """Jobs of ``stream.job_tasks`` tasks each, given the K variations of every task."""
    together = run.stream.job_tasks
    jobs = []
    for first in range(0, len(chosen), together):
        group = chosen[first : first + together]
        flat = tuple(v for variations in group for v in variations)
        jobs.append(
            Job(kind, phase.stage, phase.round, first, flat, trials, phase.policy_version, run.seed, settings, len(group))
        )
    return tuple(jobs)


def _dagger(run: Run, phase: Phase, variations: Callable[[int, Task], tuple[Variation, ...]]) -> tuple[Job, ...]:
    """T^j makes a history in every training variation, started as at test; its queries are labelled as D_pre's.

    By every rule that it may be deployed by, job by job, for each makes histories of its own
    kind; two of three by Algorithm 1, whose histories D_pre is least like.
    """
    chosen = [variations(i, splits.deployed(task)) for i, task in enumerate(splits.split(run).train)]
    jobs = _jobs(run, phase, "adapt", chosen, run.dagger.trials, _labelling(run))
    rules: tuple[Deployment, ...] = ("paper", "committed", "paper") if run.model.window > 1 else ("paper",)
    return tuple(
        dataclasses.replace(job, settings=(*job.settings, *_deployment(run, rules[(phase.round + number) % len(rules)])))
        for number, job in enumerate(jobs)
    )


def _deployment(run: Run, rule: Deployment) -> Params:
    """How T^j is deployed."""
    return (("context_max", run.context.max), ("deploy", rule))


def _labelled(run: Run, trials: Sequence[Trajectory]) -> Examples:
    """A variation's episodes with the queries and windows that were labelled when they were collected."""
    alone = np.concatenate([np.arange(len(t.queries)) < len(t.queries) - len(t.taken) for t in trials])
    names = ("queries", "labels", "taken", "gained")
    queries, labels, taken, gained = (np.concatenate([getattr(t, name) for t in trials]) for name in names)
    windows = LabelledWindows.cut(run.model.window, queries[~alone], taken, gained, labels[~alone])
    return Examples.of(trials, queries[alone], labels[alone], trials[0].identity.stage == "adapt", windows)


def _shelf(run: Run, data: Dataset) -> Shelf[Key]:
    """Every variation's examples, read from the dataset when a batch needs them."""

    def read(key: Key) -> Examples:
        trials = data.trials(key)
        examples = self_labelled(run, trials) if trials[0].origin == "none" else _labelled(run, trials)
        assert examples is not None, "only variations that give labels are asked for"
        return examples

    return Shelf(run.learner.cache_mb << 20, read)


# DPT (section 2): tasks without disturbance, labels from each task's optimal policy.


def _undisturbed(run: Run, index: int, task: Task, round: int = 0) -> tuple[Variation, ...]:
    return (Variation(task),)


def _dpt_ask(run: Run, phase: Phase) -> tuple[Job, ...]:
    asked = _random_contexts if phase.stage == "pretrain" else _dagger
    return asked(run, phase, functools.partial(_undisturbed, run))


def _pretrain_learn(run: Run, phase: Phase, data: Dataset) -> tuple[Pool, ...]:
    """D_pre, and in a DAgger round the histories of this and all earlier rounds."""
    shelf = _shelf(run, data)
    pretrain = Pool(1.0, Shelved(shelf, data.variations("pretrain", 0)), run.optim.episodes)
    if phase.stage == "pretrain":
        return (pretrain,)
    cache = [key for j in range(phase.round + 1) for key in data.variations("adapt", j)]
    share = run.dagger.new_fraction
    return dataclasses.replace(pretrain, share=1 - share), Pool(share, Shelved(shelf, cache), run.dagger.trials)


# ICAG (section 4.1, Algorithm 2): K variations of every task, labels from each variation's
# own optimal policy (eq. 5).


def _icag_ask(run: Run, phase: Phase) -> tuple[Job, ...]:
    asked = _random_contexts if phase.stage == "pretrain" else _dagger
    return asked(run, phase, functools.partial(splits.variations, run))


# ICAA (section 4.2, Algorithm 3): D^0 is DPT's dataset; then, round by round, the model
# labels its own rollouts.


def _icaa_phases(run: Run) -> tuple[Phase, ...]:
    """Lines 3 and 5: T^0 from D^0, then rounds j = 0..J."""
    rounds = (Phase("adapt", j, run.icaa.steps, run.icaa.learning_rate) for j in range(run.icaa.rounds + 1))
    return (*_pretrain_only(run), *rounds)


def _icaa_ask(run: Run, phase: Phase) -> tuple[Job, ...]:
    """Lines 8 to 12: T^j is deployed in every variation for N + 1 trials."""
    if phase.stage == "pretrain":
        return _dpt_ask(run, phase)
    settings: Params = (*_deployment(run, default_deployment(run.model)), ("labels", "none"))
    train = enumerate(splits.split(run).train)
    chosen = [splits.variations(run, i, splits.deployed(task), phase.round) for i, task in train]
    return _jobs(run, phase, "adapt", chosen, run.icaa.trials + 1, settings)


def _icaa_learn(run: Run, phase: Phase, data: Dataset) -> tuple[Pool, ...]:
    """Lines 13 to 19: contexts from the first trials, labels from later ones, D_pre the union."""
    shelf = _shelf(run, data)
    pretrain = Shelved(shelf, data.variations("pretrain", 0))
    labelling: list[Key] = []
    if phase.stage == "adapt":
        for key in (key for j in range(phase.round + 1) for key in data.variations("adapt", j)):
            examples = self_labelled(run, data.trials(key))
            if examples is not None:
                labelling.append(key)
                shelf.put(key, examples)
    if not labelling:
        return (Pool(1.0, pretrain, run.optim.episodes),)
    share = run.icaa.new_fraction
    return (Pool(1 - share, pretrain, run.optim.episodes), Pool(share, Shelved(shelf, labelling), run.optim.episodes))


def self_labelled(run: Run, trials: Sequence[Trajectory]) -> Examples | None:
    """One variation's trials as examples (lines 13 and 14); None if no trial is fit to label.

    The first N_ + 1 trials are contexts; query states and labels are the states and actions
    of strictly later trials, all or the best of them as ``icaa.label_trials`` says.
    """
    contexts, later = trials[: run.icaa.context_trials + 1], list(trials[run.icaa.context_trials + 1 :])
    if run.icaa.label_trials == "top_return":
        later = sorted(later, key=lambda t: -t.episode_return)[: (len(later) + 1) // 2]
    elif run.icaa.label_trials == "improved":
        before = np.mean([t.episode_return for t in contexts])
        later = [t for t in later if t.episode_return > before]
    if not later:
        return None
    queries = np.concatenate([t.observations[:-1] for t in later])
    actions = np.concatenate([t.actions for t in later])
    labels = actions if actions.ndim == 2 else np.eye(trials[0].labels.shape[1], dtype=np.float32)[actions]
    length, horizon = run.model.window, len(later[0].actions)
    whole = np.arange(len(later) * horizon).reshape(-1, horizon)[:, : horizon // length * length].ravel()
    gained = np.concatenate([t.rewards for t in later])
    windows = LabelledWindows.cut(length, queries[whole], actions[whole], gained[whole], labels[whole])
    return Examples.of(contexts, queries, labels, run.icaa.context == "history", windows)


def _nothing_learned(run: Run, phase: Phase, data: Dataset) -> tuple[Pool, ...]:
    return ()


METHODS: dict[str, Method] = {
    "experts": Method(
        lambda run: (Phase("pretrain", 0, 0, run.optim.learning_rate),), _icag_ask, _nothing_learned, splits.variations
    ),
    "dpt": Method(_then_dagger, _dpt_ask, _pretrain_learn, _undisturbed),
    "icag": Method(_then_dagger, _icag_ask, _pretrain_learn, splits.variations),
    "icaa": Method(_icaa_phases, _icaa_ask, _icaa_learn, splits.variations),
}


def about(run: Run, phases: Sequence[Phase], jobs: Sequence[Job]) -> dict[str, Any]:
    """What a run is about, as monitors are told (docs/tap.md); ``jobs``: those of all its phases."""
    places = {row for job in jobs for row in job.rows()}
    return {
        "method": run.method,
        "problem": run.problem,
        "phases": [[phase.stage, phase.round, phase.steps] for phase in phases],
        "rounds": sum(phase.stage == "adapt" for phase in phases),
        "tasks": len({task for task, _ in places}),
        "variations": len(places),
    }
