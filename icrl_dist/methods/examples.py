"""Training examples of the DPT family: contexts, labelled queries and action windows of each variation."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw, TrajectoryDataset, VariationKey
from icrl_dist.methods import own_labels
from icrl_dist.training import batches
from icrl_dist.training.batches import Examples, ExamplesCache, LabelledWindows, Pool
from icrl_dist.types import Trajectory


def labelled(run: Run, trials: Sequence[Trajectory]) -> Examples:
    """A variation's episodes as examples, with the queries and action windows that the worker labelled."""
    single = np.concatenate([np.arange(len(t.queries)) < len(t.queries) - len(t.prev_actions) for t in trials])
    names = ("queries", "labels", "prev_actions", "prev_rewards")
    queries, labels, prev_actions, prev_rewards = (np.concatenate([getattr(t, name) for t in trials]) for name in names)
    windows = LabelledWindows.cut(run.model.window, queries[~single], prev_actions, prev_rewards, labels[~single])
    return Examples.of(trials, queries[single], labels[single], trials[0].identity.stage == "adapt", windows)


def self_labelled(run: Run, trials: Sequence[Trajectory]) -> Examples | None:
    """One variation's trials as examples (Algorithm 3, lines 13 and 14); None if no trial can label.

    The first N_ + 1 trials become contexts, or all of them with ``icaa.context = "any"``.  The states and actions of
    later trials become query states and labels; ``icaa.label_trials`` selects these trials.  With other ``icaa.labels``
    than ``actions`` all trials are compared, and each state has one label.
    """
    contexts, later = trials[: run.icaa.context_trials + 1], list(trials[run.icaa.context_trials + 1 :])
    if run.icaa.labels != "actions":
        compare = own_labels.of_returns if run.icaa.labels == "returns" else own_labels.of_transitions
        found = compare(trials, run.icaa.label_gamma, run.icaa.label_slack)
        episodes = trials if run.icaa.context == "any" else contexts
        return found and Examples.of(episodes, *found, run.icaa.context == "history")
    if run.icaa.label_trials == "top_return":
        later = sorted(later, key=lambda t: -t.episode_return)[: (len(later) + 1) // 2]
    elif run.icaa.label_trials == "improved":
        baseline = np.mean([t.episode_return for t in contexts])
        later = [t for t in later if t.episode_return > baseline]
    if not later:
        return None
    queries, labels = own_labels.of_actions(later)
    actions = np.concatenate([t.actions for t in later])
    length, horizon = run.model.window, len(later[0].actions)
    steps = np.arange(len(later) * horizon).reshape(-1, horizon)[:, : horizon // length * length].ravel()
    rewards = np.concatenate([t.rewards for t in later])
    windows = LabelledWindows.cut(length, queries[steps], actions[steps], rewards[steps], labels[steps])
    return Examples.of(contexts, queries, labels, run.icaa.context == "history", windows)


def cache(
    run: Run, dataset: TrajectoryDataset, make: Callable[[Run, Sequence[Trajectory]], Examples | None]
) -> ExamplesCache[VariationKey]:
    """A cache of every variation's examples: ``make`` makes them from the dataset when a batch needs them."""

    def read(key: VariationKey) -> Examples:
        found = make(run, dataset.trials(key))
        assert found is not None, "batches are drawn only from variations that give labels"
        return found

    return ExamplesCache(run.learner.cache_mb << 20, read)


def draw(run: Run, pools: Sequence[Pool]) -> Draw:
    """What draws the training batches of these pools (``training.batches.draw``)."""
    optim = run.optim
    return functools.partial(
        batches.draw,
        pools=pools,
        batch=optim.batch,
        queries=optim.queries,
        transitions=optim.transitions,
        windows=optim.windows,
    )
