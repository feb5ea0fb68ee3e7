"""The suite ``posterior``: online return of a model relative to the exact agent (Theorem E.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.interfaces import MakePolicy
from icrl_dist.problems import registry
from icrl_dist.results import evaluate, statistics, summaries
from icrl_dist.results.evaluate import Agent, Result
from icrl_dist.types import Task

if TYPE_CHECKING:
    import pandas as pd

EXACT = Agent("exact:paper")
RESAMPLES = 4000
"""Bootstrap resamples."""


def online(
    run: Run,
    model: tuple[Agent, MakePolicy],
    tasks: Sequence[Task],
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
) -> list[Result]:
    """Online returns of a model and of the exact agent under Algorithm 1, with the same adversaries and draws."""
    exact = registry.of(run).exact
    assert exact is not None, "``heldout.check_suite`` refuses problems without exact answers"
    return evaluate.online(run, dict([model, (EXACT, exact.agent(run, "paper"))]), progress, tasks)


def gaps(frame: pd.DataFrame, seed: int) -> dict[str, dict[str, Any]]:
    """By p: the ``gap`` of the model to the exact agent, from rows of ``online`` for one set of tasks.

    ``seed``: of the run.  Raises ConfigError if the exact agent's mean return is not above 0.
    """
    found = summaries.returns(frame)
    exact = {one.p: one for one in found if one.agent.agent == EXACT.key}
    models = [one for one in found if one.agent.agent != EXACT.key]
    return {f"{one.p:g}": gap(one.returns[0], exact[one.p].returns[0], one.p, seed) for one in models}


def gap(
    model: Float64[np.ndarray, "tasks seeds episodes"], exact: Float64[np.ndarray, "tasks seeds episodes"], p: float, seed: int
) -> dict[str, Any]:
    """Ratio of mean returns minus 1, with a 95% bootstrap interval over goals and, within each goal, seeds, in pairs.

    Also both means and the numbers of tasks, seeds and episodes.  Raises ConfigError if the exact agent's mean
    return is not above 0.
    """
    scores = np.stack([model, exact]).mean(axis=-1)[:, None]
    means = {"model": float(scores[0].mean()), "exact": float(scores[1].mean())}
    if not means["exact"] > 0:
        raise ConfigError(f"the exact agent's return is {means['exact']:g} at p = {p:g}: no ratio to it; try more --episodes")
    rng = generator(seed, RandomKey.POSTERIOR_SUITE)
    drawn = statistics.bootstrap(scores, lambda drawn: statistics.ratio(drawn[:, 0], drawn[:, 1])[:, None] - 1, rng, RESAMPLES)
    low, high = (float(side[0]) for side in statistics.interval(drawn))
    counts = dict(zip(("tasks", "seeds", "episodes"), model.shape, strict=True))
    return {"gap": means["model"] / means["exact"] - 1, "low": low, "high": high, **means, **counts}
