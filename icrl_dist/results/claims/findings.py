"""Effects of comparisons in pairs, and their verdicts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.run import ConfigError
from icrl_dist.results import statistics
from icrl_dist.results.figures.choices import Choice, Spot, run_of
from icrl_dist.results.figures.reading import Arm
from icrl_dist.results.figures.selection import MissingError, Study
from icrl_dist.results.returns import LAST
from icrl_dist.results.statistics import Interval

SEEDS = 5
"""Training seeds that a verdict needs."""
MAIN = ("dpt", "icag", "icaa")
MAIN_SEEDS = 10
"""Training seeds that are wanted where the methods of ``MAIN`` are compared with each other."""
MARGIN = 0.01
"""Share of the oracle's mean return by which one agent may be above another that suffices."""
HELD, NOT_HELD, NOT_SHOWN, NOT_DECIDABLE = "held", "not held", "not shown", "not decidable"
UNKNOWN = Interval(math.nan, math.nan, math.nan)


class Term(NamedTuple):
    """One mean return of a comparison, with its weight: +1 and -1 of a difference."""

    weight: float
    choice: Choice
    spot: Spot


class Question(NamedTuple):
    """A comparison, and on which side of 0 the claim puts it."""

    comparison: str
    terms: Sequence[Term]
    sign: int = 1
    """1: the claim says above 0; -1: below."""
    form: str = "{:+.2f}"
    margin: Term | None = None
    """The claim puts the comparison on that side of this term instead of 0."""
    needed: bool = True
    """Whether the claim holds only if this comparison held; else it is shown beside the claim."""


@dataclass(frozen=True)
class Finding:
    """The answer to one question."""

    comparison: str
    effect: Interval
    """Of the last episodes."""
    overall: Interval
    """Of the mean over all episodes."""
    certified: float
    """The same comparison of certified returns; nan where one is not known."""
    seeds: int
    verdict: str
    reason: str = ""
    """Why it is not decidable."""
    form: str = "{:+.2f}"
    margin: float = 0.0
    """What the interval was compared with, in place of 0."""
    needed: bool = True
    """Whether the claim depends on it."""
    main: bool = False
    """Whether it compares methods of ``MAIN`` with each other."""
    shared_splits: bool = False
    """Whether several of its trainings have the same split of the tasks."""


def verdict(effect: Interval, sign: int, seeds: int, margin: float = 0.0) -> str:
    """Whether the interval lies on the claimed side of the margin, on the other, or contains it; few seeds: not decidable."""
    if seeds < SEEDS or math.isnan(effect.low):
        return NOT_DECIDABLE
    side = {"higher": 1, "lower": -1}.get(effect.verdict(margin), 0)
    return {0: NOT_SHOWN, sign: HELD}.get(side, NOT_HELD)


def few(seeds: int) -> str:
    """Why this number of training seeds is too small for a verdict; empty if it is not."""
    return "" if seeds >= SEEDS else f"{statistics.counted(seeds, 'training seed')}, and at least {SEEDS} are needed"


def together(verdicts: Sequence[str]) -> str:
    """The verdict of a claim with several comparisons: it held only if each did."""
    order = (NOT_HELD, NOT_DECIDABLE, NOT_SHOWN, HELD)
    return next((one for one in order if one in verdicts), NOT_DECIDABLE)


def arms_of(study: Study, what: str, terms: Sequence[Term]) -> list[Arm]:
    """The arms of the terms.  Raises MissingError for those without rows, ConfigError for those that may not be compared."""
    found = [term.choice.at(study, term.spot) for term in terms]
    missing = [run_of(study, t.choice, [t.spot]) for t, arm in zip(terms, found, strict=True) if arm is None]
    if missing:
        raise MissingError(what, missing)
    return study.comparable([arm for arm in found if arm is not None], what)


def answer(study: Study, question: Question) -> Finding:
    """The effect of a comparison, the sum of weight times mean return, with the same resamples for all of its terms."""
    try:
        arms, margin = _with_margin(study, question, arms_of(study, question.comparison, question.terms))
    except ConfigError as error:
        reason = str(error).removeprefix(f"{question.comparison}: ")
        none = Finding(question.comparison, UNKNOWN, UNKNOWN, math.nan, 0, NOT_DECIDABLE, reason, question.form)
        return dataclasses.replace(none, needed=question.needed)
    weights = np.array([term.weight for term in question.terms])
    episodes = arms[0].returns.shape[3]
    scores = np.stack([arm.scores(last) for last in (LAST, episodes) for arm in arms])
    effect, overall = statistics.estimate(scores, _weighted(weights), all(arm.crossed for arm in arms))
    certified = float(weights @ [arm.worst() for arm in arms])
    seeds = len(arms[0].seeds)
    return Finding(
        question.comparison,
        effect,
        overall,
        certified,
        seeds,
        verdict(effect, question.sign, seeds, margin),
        few(seeds),
        question.form,
        margin,
        question.needed,
        len({term.choice.style for term in question.terms if term.choice.style in MAIN}) > 1,
        arms[0].shared_splits,
    )


def _with_margin(study: Study, question: Question, arms: list[Arm]) -> tuple[list[Arm], float]:
    """The arms, and the margin of the question from the same training seeds; not below 0."""
    if question.margin is None:
        return arms, 0.0
    (of,) = arms_of(study, question.comparison, [question.margin])
    *arms, of = study.comparable([*arms, of.only(arms[0].seeds)], question.comparison)
    return arms, max(0.0, question.margin.weight * float(of.scores().mean()))


def _weighted(weights: np.ndarray) -> Callable[[Float64[np.ndarray, "R A S C"]], Float64[np.ndarray, "R 2"]]:
    """Two weighted sums of mean scores: of the first half of the agents, and of the second."""

    def of(scores: Float64[np.ndarray, "R A S C"]) -> Float64[np.ndarray, "R 2"]:
        return statistics.mean(scores).reshape(len(scores), 2, -1) @ weights

    return of


def difference(comparison: str, one: Choice, other: Choice, spot: Spot, sign: int = 1) -> Question:
    """The question whether ``one`` is above ``other`` at a place."""
    return Question(comparison, [Term(1.0, one, spot), Term(-1.0, other, spot)], sign)
