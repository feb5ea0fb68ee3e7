"""Paired comparison of two agents, or of two methods over several trainings, from result rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import ConfigError
from icrl_dist.results import statistics
from icrl_dist.results.summaries import LAST, Interval, Returns, returns

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
        if math.isnan(self.effect.low) or self.effect.low <= self.neutral <= self.effect.high:
            return "not shown"
        return "higher" if self.effect.low > self.neutral else "lower"


def newest_model(frame: pd.DataFrame) -> list[Returns]:
    """The newest policy version in rows of the suite ``online``, by p; of any other rows the only agent in them.

    If two rules deploy it, the rule is the one that is not Algorithm 1.  Raises ConfigError for rows with several
    agents of which none is a model.
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
    return [one for one in found if one.agent == chosen]


def compare(first: Returns, second: Returns, last: int = LAST) -> list[Comparison]:
    """Statistics of the mean return over the last episodes, with 95% intervals of ``statistics.bootstrap``.

    Pairs are rows of equal training seed, split seed, task, adversary and evaluation seed, in both agents.  Raises
    ConfigError if a row has no partner.
    """
    _check_pairs(first, second)
    scores = np.stack([first.scores(last), second.scores(last)])
    values = _statistics(scores.mean(axis=-1)[None])[0]
    drawn = statistics.bootstrap(scores, _statistics, generator(0, RandomKey.RESULTS), crossed=first.crossed)
    low, high = statistics.interval(drawn)
    count, answer = len(SINGLE), []
    for i, name in enumerate((*SINGLE, "ratio", "improvement")):
        column = 2 * count + i
        one, two = (float(values[2 * i]), float(values[2 * i + 1])) if name in SINGLE else (None, None)
        effect = Interval(float(values[column]), float(low[column]), float(high[column]))
        answer.append(Comparison(first.p, name, one, two, effect, 0.5 if name == "improvement" else 0.0))
    return answer


def _statistics(scores: Float64[np.ndarray, "R 2 S C"]) -> Float64[np.ndarray, "R K"]:
    """Each single statistic of the first and the second agent, the differences, the ratio less 1, the improvement."""
    first, second = scores[:, 0], scores[:, 1]
    pairs = [(of(first), of(second)) for of in SINGLE.values()]
    differences = [two - one for one, two in pairs]
    both = [statistics.ratio(second, first) - 1, statistics.probability_of_improvement(second, first)]
    return np.stack([number for pair in pairs for number in pair] + differences + both, axis=-1)


def _check_pairs(first: Returns, second: Returns) -> None:
    for what, one, two in (
        ("training seeds", first.training_seeds, second.training_seeds),
        ("evaluation seeds", first.evaluation_seeds, second.evaluation_seeds),
        ("episodes", first.returns.shape[3], second.returns.shape[3]),
        ("tasks", len(first.cells[0]), len(second.cells[0])),
    ):
        if one != two:
            raise ConfigError(
                f"comparison at p = {first.p:g}: {what} are {one} of {first.name} and {two} of {second.name}, so rows have no "
                "partner: choose rows that both have, or evaluate again with equal settings"
            )
    for seed, ones, twos in zip(first.training_seeds, first.cells, second.cells, strict=True):
        for index, (one, two) in enumerate(zip(ones, twos, strict=True)):
            if one != two:
                raise ConfigError(
                    f"comparison at p = {first.p:g}, training seed {seed}, task {index}: {first.name} has {_cell(one)} and "
                    f"{second.name} has {_cell(two)}: rows are paired by split seed, task and adversary, so evaluate both alike"
                )


def _cell(cell: tuple[object, ...]) -> str:
    split, task, family, adversary = cell
    return f"split seed {split}, task {task}, adversary {family} {adversary}"
