"""The suite ``posterior``: a model beside the exact posterior (Theorem E.3), in decisions and in return."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.interfaces import MakePolicy
from icrl_dist.problems import registry
from icrl_dist.results import evaluate
from icrl_dist.results.evaluate import Result
from icrl_dist.types import Task

RESAMPLES = 4000
"""Bootstrap resamples."""


def gaps(
    run: Run,
    act: MakePolicy,
    goals: Sequence[Task],
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
) -> dict[str, Any]:
    """By p: how far the online return of an agent is from the exact agent's under Algorithm 1, as a share of it.

    Both have the same goals, adversaries and draws; the mean is over all episodes.
    """
    exact = registry.of(run).exact
    assert exact is not None, "only a problem with exact answers has this suite"
    agents = {"model": act, "exact": exact.agent(run, "paper")}
    results = evaluate.online(run, agents, progress, goals)
    return {f"{model.p:g}": gap(model, exact, run.seed) for model, exact in zip(results[::2], results[1::2], strict=True)}


def gap(model: Result, exact: Result, seed: int) -> dict[str, float]:
    """Ratio of mean returns less 1, with its 95% bootstrap interval: goals, and of each its seeds, drawn anew in pairs."""
    one, two = (r.returns.mean(axis=2) for r in (model, exact))
    goals, seeds = one.shape
    rng = generator(seed, RandomKey.POSTERIOR_SUITE)
    chosen = rng.integers(0, goals, size=(RESAMPLES, goals, 1)), rng.integers(0, seeds, size=(RESAMPLES, goals, seeds))
    if not two.mean() > 0:
        raise ConfigError(f"the exact agent's return is {two.mean():g} at p = {model.p:g}: no ratio to it; try more --episodes")
    above = two[chosen].mean(axis=(1, 2))
    low, high = np.percentile(one[chosen].mean(axis=(1, 2))[above > 0] / above[above > 0] - 1, (2.5, 97.5))
    means = {"model": float(one.mean()), "exact": float(two.mean())}
    return {"gap": means["model"] / means["exact"] - 1, "low": float(low), "high": float(high), **means}
