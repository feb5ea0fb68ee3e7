"""Statistics of returns: pure functions on arrays, for summaries of rows and for tables.

Scores are arrays of shape (..., trainings, cells, evaluations): a *training* is one training seed, a *cell* is one
task, an *evaluation* is one deployment of the agent in a cell from an empty context, under an adversary draw of its own,
and its score is a return, or the mean return over some of its episodes.

References: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021 (IQM,
probability of improvement; the estimators are those of its library rliable).  Efron and Tibshirani, "An Introduction
to the Bootstrap", 1993 (bootstrap standard errors and Student's t, chapters 6 and 12).  Owen, "The pigeonhole bootstrap",
Annals of Applied Statistics 1(2), 2007 (resampling of crossed factors).  Davison and Hinkley, "Bootstrap Methods and their
Application", 1997 (resampling of nested factors, section 3.8).  Agresti and Coull, "Approximate is better than
exact for interval estimation of binomial proportions", The American Statistician 52(2), 1998.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64

from icrl_dist.config.random_keys import RandomKey, generator

RESAMPLES = 2000
"""Bootstrap resamples of an interval."""
LEVEL = 0.95
"""Probability that an interval should cover."""
_CHUNK = 500_000
"""Indices that are drawn at once; it bounds the memory of a bootstrap."""


class Interval(NamedTuple):
    """An estimate and its 95% interval; nan where they are unknown."""

    value: float
    low: float
    high: float

    def verdict(self, neutral: float = 0.0) -> str:
        """``higher`` or ``lower`` if the interval lies on one side of ``neutral``, else ``not shown``."""
        return "higher" if self.low > neutral else "lower" if self.high < neutral else "not shown"


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
    """Worst case: the smallest score of each training over its cells (tasks), averaged over trainings.

    The minimum of noisy means lies below the smallest true mean, so compare only minima over equal numbers of cells
    and evaluations.
    """
    return np.asarray(scores.min(axis=-1).mean(axis=-1))


def probability_of_improvement(
    x: Float[np.ndarray, "*batch S C"], y: Float[np.ndarray, "*batch Z C"], crossed: bool = True
) -> np.ndarray:
    """Probability that a training of X is better than a training of Y in a cell that is drawn at random.

    (1 / C) sum over cells c of U_c / (S * Z), where the Mann-Whitney statistic U_c is the number of pairs (i, j) with
    x[i, c] > y[j, c], and half the number of ties (Agarwal et al. 2021, section 4.3; the estimator of
    ``rliable.metrics.probability_of_improvement``).  Without ``crossed``, cell c of training i is another task than cell c
    of training j, so only the pairs i = j count; S = Z.
    """
    if not crossed:
        return mean((x > y) + 0.5 * (x == y))
    one, two = x[..., :, None, :], y[..., None, :, :]
    return np.asarray(((one > two) + 0.5 * (one == two)).mean(axis=(-3, -2, -1)))


def ratio(x: Float[np.ndarray, "*batch S C"], y: Float[np.ndarray, "*batch S C"]) -> np.ndarray:
    """Mean of X divided by the mean of Y (a ratio of means, not a mean of ratios); see ``quotient``."""
    return quotient(mean(x), mean(y))


def quotient(above: Float[np.ndarray, "*shape"], below: Float[np.ndarray, "*shape"]) -> np.ndarray:
    """``above`` divided by ``below``; nan where ``below`` is not above 0, because a share of a loss means nothing."""
    return np.divide(above, below, out=np.full(np.shape(below), np.nan), where=np.asarray(below) > 0)


class Resample(NamedTuple):
    """Indices of R bootstrap resamples."""

    trainings: Int64[np.ndarray, "R S 1 1"]
    cells: Int64[np.ndarray, "R|1 S|1 C 1"]
    evaluations: Int64[np.ndarray, "R|1 S|1 C|1 E"]


def resamples(
    rng: np.random.Generator, shape: tuple[int, int, int], count: int, crossed: bool, fixed_cells: bool = False
) -> Iterator[Resample]:
    """Indices of ``count`` resamples of S trainings, C cells and E evaluations, in chunks; draws are with replacement.

    First the trainings are drawn, then the cells, then the evaluations within each drawn cell, as follows.  ``crossed``: all
    trainings were evaluated in the same cells, so a resample has the same cells in all of its trainings (Owen 2007).
    Otherwise each of several trainings has cells of its own: it is drawn with all its cells and evaluations, because
    training means already vary by them, and to draw them again would count their variance twice (Davison and
    Hinkley 1997, section 3.8).  For the same reason the cells of a single training are drawn with all their evaluations.
    ``fixed_cells``: every resample has all cells once.
    """
    s, c, e = shape
    step = max(1, _CHUNK // (s * c * e))
    for first in range(0, count, step):
        r = min(step, count - first)
        trainings, cells = rng.integers(0, s, size=(r, s, 1, 1)), np.arange(c).reshape(1, 1, c, 1)
        evaluations = np.arange(e).reshape(1, 1, 1, e)
        whole_trainings = s > 1 and not crossed
        whole_cells = s == 1 and c > 1 and not fixed_cells
        if not (whole_trainings or fixed_cells):
            cells = rng.integers(0, c, size=(r, 1, c, 1))
        if not (whole_trainings or whole_cells):
            evaluations = rng.integers(0, e, size=(r, s, c, e))
        yield Resample(trainings, cells, evaluations)


def bootstrap(
    scores: Float[np.ndarray, "A S C E"],
    statistic: Statistic,
    rng: np.random.Generator,
    count: int = RESAMPLES,
    crossed: bool = True,
    fixed_cells: bool = False,
) -> Float64[np.ndarray, "R K"]:
    """Paired hierarchical bootstrap: K numbers of ``statistic`` for each of ``count`` resamples.

    Resamples training seeds, then tasks, then evaluations with their adversary draws, nested (see ``resamples``).  Every
    resample has the same indices for all A agents, so differences and ratios of agents are compared in pairs.
    """
    found = []
    for chosen in resamples(rng, scores.shape[1:], count, crossed, fixed_cells):
        drawn = scores[:, chosen.trainings, chosen.cells, chosen.evaluations]
        found.append(statistic(np.moveaxis(drawn.mean(axis=-1), 0, 1)))
    return np.concatenate(found)


def estimate(
    scores: Float[np.ndarray, "A S C E"],
    statistic: Statistic,
    crossed: bool = True,
    fixed_cells: bool = False,
    probability: bool = False,
) -> list[Interval]:
    """The K numbers of ``statistic`` with 95% intervals of a paired hierarchical bootstrap (``bootstrap``, ``bounds``).

    Equal scores give equal intervals, because the draws are those of one fixed stream.  ``fixed_cells``: do not
    resample cells; a minimum over cells needs this, because a resample without the worst cell has another minimum.
    ``probability``: the numbers are probabilities.
    """
    values = statistic(scores.mean(axis=-1)[None])[0]
    count = units(scores.shape[1:], fixed_cells)
    drawn = bootstrap(scores, statistic, generator(0, RandomKey.RESULTS), RESAMPLES, crossed, fixed_cells)
    low, high = bounds(values, drawn, count, probability)
    return [Interval(*map(float, one)) for one in zip(values, low, high, strict=True)]


def units(shape: tuple[int, ...], fixed_cells: bool = False) -> int:
    """How many independent units an interval is over: trainings; with one training, cells; with one cell, evaluations."""
    trainings, cells, evaluations = shape
    return next((count for count in (trainings, 1 if fixed_cells else cells, evaluations) if count > 1), 1)


def bounds(
    values: Float[np.ndarray, " K"], drawn: Float[np.ndarray, "R K"], count: int, probability: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the 95% intervals of K numbers, from their bootstrap over ``count`` units.

    The number +- t * s * sqrt(n / (n - 1)): n is ``count``, t the quantile of Student's t with n - 1 degrees of freedom, and
    s the standard deviation of the resampled numbers, which the factor corrects, because resamples of n units
    vary by (n - 1) / n too little.  The bounds are nan for one unit, and where the number or any resample is undefined.

    ``probability``: the bounds are in [0, 1], and the standard error is at least that of n successes in n trials with
    one success and one failure added, sqrt((n + 1) / (n + 2)^3) (the remedy of Agresti and Coull 1998 for a
    standard error of 0).  Otherwise 2 trainings that are better than 2 others by chance would have a standard error of 0.
    """
    from scipy.special import stdtrit  # imported here because it is slow to import, and the learner imports this module

    if count < 2:
        return np.full(np.shape(values), np.nan), np.full(np.shape(values), np.nan)
    error = drawn.std(axis=0, ddof=1) * math.sqrt(count / (count - 1))
    if probability:
        error = np.maximum(error, math.sqrt((count + 1) / (count + 2) ** 3))
    half = stdtrit(count - 1, (1 + LEVEL) / 2) * error
    low, high = values - half, values + half
    return (np.clip(low, 0, 1), np.clip(high, 0, 1)) if probability else (low, high)


def spread(count: int) -> float:
    """Factor from the variance of a bootstrap over ``count`` units to (half the width of a 95% interval) ** 2."""
    from scipy.special import stdtrit

    return float(stdtrit(count - 1, (1 + LEVEL) / 2) ** 2 * count / (count - 1))


def resampled(trainings: int, tasks: int, evaluations: int, episodes: int = 1, draws: int = 1) -> str:
    """What an interval was resampled over, in words, for the caption of a table.

    ``episodes``: consecutive episodes of one evaluation that a score is the mean of.  ``draws``: different adversaries
    of one task; with one, as without disturbance or with a prior of a single adversary, all evaluations have the same.
    """
    if units((trainings, tasks, evaluations)) == 1:
        return "one training, one evaluation of one task: no intervals"
    each = counted(evaluations, "evaluation") + " of each"
    if draws > 1:
        over = f"{counted(tasks, 'task')}, {each} with an adversary draw of its own"
    else:
        over = f"{counted(tasks, 'task')} with {'its adversary' if tasks == 1 else 'their adversaries'}, {each}"
    if episodes > 1:
        over += f", {episodes} episodes an evaluation"
    if trainings == 1:
        return f"one training: 95% interval over {over}; it says nothing about other training seeds"
    return f"95% interval over {trainings} training seeds, {over}"


def counted(number: int, what: str) -> str:
    """A number and its noun, such as ``2 tasks``."""
    return f"{number} {what}{'' if number == 1 else 's'}"
