"""The suite ``posterior``: online return of a model relative to the exact agent (Theorem E.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.interfaces import MakePolicy
from icrl_dist.problems import registry
from icrl_dist.results import evaluate, statistics
from icrl_dist.results.evaluate import Agent, Result
from icrl_dist.results.returns import returns
from icrl_dist.types import Task

if TYPE_CHECKING:
    import pandas as pd

EXACT = Agent("exact:paper")


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


def gaps(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """By p: the ``gap`` of the model to the exact agent, from rows of ``online`` for one set of tasks.

    ``draws``: different adversaries of one task.

    Raises ConfigError if the exact agent's mean return is not above 0.
    """
    found = returns(frame)
    exact = {one.p: one for one in found if one.agent.agent == EXACT.key}
    models = [one for one in found if one.agent.agent != EXACT.key]
    return {f"{one.p:g}": {**gap(one.returns[0], exact[one.p].returns[0], one.p), "draws": one.draws} for one in models}


def gap(
    model: Float64[np.ndarray, "tasks seeds episodes"], exact: Float64[np.ndarray, "tasks seeds episodes"], p: float
) -> dict[str, Any]:
    """Ratio of mean returns minus 1, with a 95% interval over goals and, within each, seeds (adversary draws), in pairs.

    The interval is that of ``statistics.estimate``; its bounds are None where it has none.  Also both means and the
    numbers of tasks, seeds and episodes.  Raises ConfigError if the exact agent's mean
    return is not above 0.
    """
    scores = np.stack([model, exact]).mean(axis=-1)[:, None]
    means = {"model": float(scores[0].mean()), "exact": float(scores[1].mean())}
    if not means["exact"] > 0:
        raise ConfigError(f"the exact agent's return is {means['exact']:g} at p = {p:g}: no ratio to it; try more --episodes")
    (found,) = statistics.estimate(scores, lambda drawn: statistics.ratio(drawn[:, 0], drawn[:, 1])[:, None] - 1)
    low, high = (None if np.isnan(bound) else bound for bound in (found.low, found.high))
    counts = dict(zip(("tasks", "seeds", "episodes"), model.shape, strict=True))
    return {"gap": found.value, "low": low, "high": high, **means, **counts}
