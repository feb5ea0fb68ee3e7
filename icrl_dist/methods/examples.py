"""Training examples of the DPT family: contexts, labelled queries and action windows of each variation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw, TrajectoryDataset, VariationKey
from icrl_dist.training import batches
from icrl_dist.training.batches import Examples, LabelledWindows, Pool, Shelf
from icrl_dist.types import Trajectory


def labelled(run: Run, trials: Sequence[Trajectory]) -> Examples:
    """A variation's episodes with the queries and action windows that were labelled when they were collected."""
    alone = np.concatenate([np.arange(len(t.queries)) < len(t.queries) - len(t.taken) for t in trials])
    names = ("queries", "labels", "taken", "gained")
    queries, labels, taken, gained = (np.concatenate([getattr(t, name) for t in trials]) for name in names)
    windows = LabelledWindows.cut(run.model.window, queries[~alone], taken, gained, labels[~alone])
    return Examples.of(trials, queries[alone], labels[alone], trials[0].identity.stage == "adapt", windows)


def self_labelled(run: Run, trials: Sequence[Trajectory]) -> Examples | None:
    """One variation's trials as examples (Algorithm 3, lines 13 and 14); None if no trial is fit to label.

    The first N_ + 1 trials are contexts; query states and labels are the states and actions
    of strictly later trials, all or the best of them by ``icaa.label_trials``.
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


def shelf(
    run: Run, data: TrajectoryDataset, examples: Callable[[Run, Sequence[Trajectory]], Examples | None]
) -> Shelf[VariationKey]:
    """Every variation's examples, read from the dataset when a batch needs them."""

    def read(key: VariationKey) -> Examples:
        found = examples(run, data.trials(key))
        assert found is not None, "only variations that give labels are drawn"
        return found

    return Shelf(run.learner.cache_mb << 20, read)


def draw(run: Run, pools: Sequence[Pool]) -> Draw:
    """Draws training batches from these pools (``training.batches.draw``)."""
    optim = run.optim
    return lambda rng: batches.draw(rng, pools, optim.batch, optim.queries, optim.transitions, optim.windows)
