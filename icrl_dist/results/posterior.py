"""The suite ``posterior``: online return of a model relative to the exact agent (Theorem E.3)."""

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
    """By p: online return of a policy relative to that of the exact agent under Algorithm 1; see ``gap``.

    Both have the same goals, adversaries and draws.
    """
    exact = registry.of(run).exact
    assert exact is not None, "``heldout.check_suite`` refuses problems without exact answers"
    agents = {"model": act, "exact": exact.agent(run, "paper")}
    results = evaluate.online(run, agents, progress, goals)
    return {f"{model.p:g}": gap(model, exact, run.seed) for model, exact in zip(results[::2], results[1::2], strict=True)}


def gap(model: Result, exact: Result, seed: int) -> dict[str, float]:
    """Ratio of mean returns minus 1, with a 95% bootstrap interval over goals and, within each goal, seeds, in pairs.

    Raises ConfigError if the exact agent's mean return is not above 0.
    """
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
