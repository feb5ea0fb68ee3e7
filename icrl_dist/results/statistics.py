"""Statistics of returns: pure functions on arrays, for summaries of rows and for tables.

Scores are arrays of shape (..., trainings, cells, evaluations): a *training* is one training seed, a *cell* is one
task with its adversary, an *evaluation* is one deployment of the agent in a cell from an empty context, and its score
is a return, or the mean return over some of its episodes.

References: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021 (IQM,
probability of improvement; the estimators are those of its library rliable).  Efron and Tibshirani, "An Introduction
to the Bootstrap", 1993 (percentile intervals, chapter 13).  Owen, "The pigeonhole bootstrap", Annals of Applied
Statistics 1(2), 2007 (resampling of crossed factors).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64

RESAMPLES = 2000
"""Bootstrap resamples of an interval in tables."""
LEVEL = 0.95
"""Probability that an interval should cover."""
_CHUNK = 500_000
"""Indices that are drawn at once; it bounds the memory of a bootstrap."""

Statistic = Callable[[Float64[np.ndarray, "R A S C"]], Float64[np.ndarray, "R K"]]
"""From mean scores of R resamples by agent, training and cell to K numbers for each resample."""


def mean_and_error(returns: Float[np.ndarray, "tasks seeds episodes"]) -> tuple[np.ndarray, np.ndarray]:
    """Mean return of each episode over tasks and seeds, and its standard error over seeds; nan with a single seed.

    The standard error is s / sqrt(n): s is the standard deviation (with n - 1) of the n seeds' means over tasks.
    """
    by_seed = returns.mean(axis=0)
    return by_seed.mean(axis=0), standard_error(by_seed)


def standard_error(values: Float[np.ndarray, "n ..."]) -> np.ndarray:
    """Standard error of the mean of n independent values, s / sqrt(n), along the first axis; nan for one value."""
    count = len(values)
    if count < 2:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(values.std(axis=0, ddof=1) / np.sqrt(count))


def mean(scores: Float[np.ndarray, "*batch S C"]) -> np.ndarray:
    """Mean over trainings and cells."""
    return np.asarray(scores.mean(axis=(-2, -1)))


def iqm(scores: Float[np.ndarray, "*batch S C"]) -> np.ndarray:
    """Interquartile mean over trainings and cells (Agarwal et al. 2021, section 4.3).

    The mean of the S * C scores without the floor(S * C / 4) smallest and the floor(S * C / 4) largest of them: the
    25% trimmed mean, as ``rliable.metrics.aggregate_iqm`` computes it.
    """
    import scipy.stats  # imported here because it is slow to import, and the learner imports this module

    flat = scores.reshape(*scores.shape[:-2], -1)
    return np.asarray(scipy.stats.trim_mean(flat, proportiontocut=0.25, axis=-1))


def minimum(scores: Float[np.ndarray, "*batch S C"]) -> np.ndarray:
    """Worst case: the smallest score of each training over its cells (tasks with their adversaries), averaged over trainings.

    The minimum of noisy means lies below the smallest true mean, so compare only minima over equal numbers of cells
    and evaluations.
    """
    return np.asarray(scores.min(axis=-1).mean(axis=-1))


def probability_of_improvement(x: Float[np.ndarray, "*batch S C"], y: Float[np.ndarray, "*batch Z C"]) -> np.ndarray:
    """Probability that a training of X is better than a training of Y in a cell that is drawn at random.

    (1 / C) sum over cells c of U_c / (S * Z), where the Mann-Whitney statistic U_c is the number of pairs (i, j) with
    x[i, c] > y[j, c], and half the number of ties (Agarwal et al. 2021, section 4.3; the estimator of
    ``rliable.metrics.probability_of_improvement``).
    """
    one, two = x[..., :, None, :], y[..., None, :, :]
    return np.asarray(((one > two) + 0.5 * (one == two)).mean(axis=(-3, -2, -1)))


def ratio(x: Float[np.ndarray, "*batch S C"], y: Float[np.ndarray, "*batch S C"]) -> np.ndarray:
    """Mean of X divided by the mean of Y (a ratio of means, not a mean of ratios); nan where the mean of Y is not above 0."""
    above, below = mean(x), mean(y)
    return np.divide(above, below, out=np.full(np.shape(below), np.nan), where=below > 0)


class Resample(NamedTuple):
    """Indices of R bootstrap resamples."""

    trainings: Int64[np.ndarray, "R S 1 1"]
    cells: Int64[np.ndarray, "R S|1 C 1"]
    evaluations: Int64[np.ndarray, "R S C E"]


def resamples(rng: np.random.Generator, shape: tuple[int, int, int], count: int, crossed: bool) -> Iterator[Resample]:
    """Indices of ``count`` resamples of S trainings, C cells and E evaluations, all with replacement, in chunks.

    First the trainings are drawn, then the cells, then the evaluations within each drawn cell.  ``crossed``: all
    trainings were evaluated in the same cells, so a resample has the same cells in all of its trainings (Owen 2007);
    otherwise cells are drawn for each training anew.
    """
    s, c, e = shape
    step = max(1, _CHUNK // (s * c * e))
    for first in range(0, count, step):
        r = min(step, count - first)
        yield Resample(
            rng.integers(0, s, size=(r, s, 1, 1)),
            rng.integers(0, c, size=(r, 1 if crossed else s, c, 1)),
            rng.integers(0, e, size=(r, s, c, e)),
        )


def bootstrap(
    scores: Float[np.ndarray, "A S C E"],
    statistic: Statistic,
    rng: np.random.Generator,
    count: int = RESAMPLES,
    crossed: bool = True,
) -> Float64[np.ndarray, "R K"]:
    """Paired hierarchical bootstrap: K numbers of ``statistic`` for each of ``count`` resamples.

    Resamples training seeds, then tasks with their adversaries, then evaluations (see ``resamples``).  Every resample
    has the same indices for all A agents, so differences and ratios of agents are compared in pairs.
    """
    found = []
    for chosen in resamples(rng, scores.shape[1:], count, crossed):
        drawn = scores[:, chosen.trainings, chosen.cells, chosen.evaluations]
        found.append(statistic(np.moveaxis(drawn.mean(axis=-1), 0, 1)))
    return np.concatenate(found)


def interval(values: Float[np.ndarray, "R *rest"], level: float = LEVEL) -> tuple[np.ndarray, np.ndarray]:
    """Percentile interval of a bootstrap: the quantiles (1 - level) / 2 and (1 + level) / 2 along the first axis.

    nan among the values, such as an undefined ratio, is left out; the interval of nothing but nan is nan.
    """
    tail, known = 50 * (1 - level), ~np.isnan(values).all(axis=0)
    low, high = np.nanpercentile(np.where(known, values, 0.0), (tail, 100 - tail), axis=0)
    return np.where(known, low, np.nan), np.where(known, high, np.nan)


def resampled(trainings: int, tasks: int, evaluations: int, episodes: int = 1) -> str:
    """What an interval was resampled over, in words, for the caption of a table.

    ``episodes``: consecutive episodes of one evaluation that a score is the mean of.
    """
    each = _count(evaluations, "evaluation") + " of each"
    if episodes > 1:
        each += f", {episodes} episodes an evaluation"
    over = f"{_count(tasks, 'task')} with {'its adversary' if tasks == 1 else 'their adversaries'}, {each}"
    if trainings == 1:
        return f"one training: 95% interval over {over}; it says nothing about other training seeds"
    return f"95% interval over {trainings} training seeds, {over}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
