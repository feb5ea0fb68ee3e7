"""Paired comparison of two agents, or of two methods over several trainings, from result rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.run import ConfigError
from icrl_dist.results import statistics
from icrl_dist.results.returns import LAST, Returns, check_pairs, returns
from icrl_dist.results.statistics import Interval

if TYPE_CHECKING:
    import pandas as pd

SINGLE = {"mean": statistics.mean, "IQM": statistics.iqm, "minimum": statistics.minimum}
"""Statistics of one agent; a comparison shows the difference of the two agents' numbers."""


@dataclass(frozen=True)
class Comparison:
    """One statistic of two agents at one p."""

    p: float
    statistic: str
    """A key of ``SINGLE``, ``ratio`` (of means, less 1) or ``improvement`` (probability of improvement)."""
    first: float | None
    second: float | None
    """The statistic of each agent; None for ``ratio`` and ``improvement``, which need both."""
    effect: Interval
    """Second less first, or the ratio or probability for the second."""
    neutral: float
    """The effect if the agents are equal: 0, and 0.5 for a probability."""

    @property
    def verdict(self) -> str:
        """``higher`` or ``lower`` if the interval lies on one side of the neutral value, else ``not shown``."""
        return self.effect.verdict(self.neutral)


def newest_model(frame: pd.DataFrame) -> list[Returns]:
    """The newest policy version in rows of the suite ``online``, by p; of any other rows the only agent in them.

    If two rules deploy it, the rule is the one that is not Algorithm 1.  Raises ConfigError for rows with several
    agents of which none is a model, for a model with several kinds of offline data, and for a training without rows
    of the chosen agent.
    """
    online = frame[frame["suite"] == "online"]
    found = returns(online if len(online) else frame)
    agents = list(dict.fromkeys(one.agent for one in found))
    models = [agent for agent in agents if agent.is_model]
    if not models and len(agents) > 1:
        keys = ", ".join(agent.agent for agent in agents)
        raise ConfigError(
            f"a comparison needs one agent of these: {keys}; choose one, as in frame[frame.agent == {agents[0].agent!r}]"
        )
    chosen = max(models, key=lambda agent: (int(agent.agent[1:]), agent.deployment != "paper")) if models else agents[0]
    if len(data := sorted({agent.data for agent in models})) > 1:
        raise ConfigError(
            f"a comparison needs one kind of offline data of these: {', '.join(data)}; choose one, as in "
            f"frame[frame.data == {data[0]!r}]"
        )
    arm = [one for one in found if one.agent == chosen]
    seeds = sorted({seed for one in found for seed in one.training_seeds})
    for one in arm:
        if missing := [str(seed) for seed in seeds if seed not in one.training_seeds]:
            raise ConfigError(
                f"a comparison needs {chosen.agent}, the newest model, of every training: at p = {one.p:g} there is none of "
                f"training seed {', '.join(missing)}; train and evaluate it, or choose rows by agent, p or training_seed"
            )
    return arm


def compare(first: Returns, second: Returns, last: int = LAST) -> list[Comparison]:
    """Statistics of the mean return over the last episodes, with 95% intervals of ``statistics.estimate``.

    Pairs are rows of equal training seed, split seed, task, adversary and evaluation seed, in both agents
    (``check_pairs``).  Raises ConfigError if a row has no partner.
    """
    check_pairs(first, second)
    if first.agent.data != second.agent.data:
        raise ConfigError(f"a comparison needs one kind of offline data: data are {first.agent.data} and {second.agent.data}")
    scores, crossed = np.stack([first.scores(last), second.scores(last)]), first.crossed

    def over_cells(of: Float64[np.ndarray, "R 2 S C"]) -> Float64[np.ndarray, "R 3"]:
        differences = [statistic(of[:, 1]) - statistic(of[:, 0]) for statistic in (statistics.mean, statistics.iqm)]
        return np.stack([*differences, statistics.ratio(of[:, 1], of[:, 0]) - 1], axis=-1)

    def minimum(of: Float64[np.ndarray, "R 2 S C"]) -> Float64[np.ndarray, "R 1"]:
        return (statistics.minimum(of[:, 1]) - statistics.minimum(of[:, 0]))[:, None]

    def improvement(of: Float64[np.ndarray, "R 2 S C"]) -> Float64[np.ndarray, "R 1"]:
        return statistics.probability_of_improvement(of[:, 1], of[:, 0], crossed)[:, None]

    mean, iqm, ratio = statistics.estimate(scores, over_cells, crossed)
    (worst,) = statistics.estimate(scores, minimum, crossed, fixed_cells=True)
    (better,) = statistics.estimate(scores, improvement, crossed, probability=True)
    one, two = scores.mean(axis=-1)
    return [
        *(
            Comparison(first.p, name, float(of(one)), float(of(two)), effect, 0.0)
            for (name, of), effect in zip(SINGLE.items(), (mean, iqm, worst), strict=True)
        ),
        Comparison(first.p, "ratio", None, None, ratio, 0.0),
        Comparison(first.p, "improvement", None, None, better, 0.5),
    ]
