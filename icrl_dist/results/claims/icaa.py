"""The table of ICAA: T^0, each round and ICAG in pairs, and the share of the gap that the rounds closed."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.results import statistics
from icrl_dist.results.claims.findings import Term, arms_of
from icrl_dist.results.claims.questions import disturbed
from icrl_dist.results.figures.choices import Choice, Spot
from icrl_dist.results.figures.panels import resampled
from icrl_dist.results.figures.reading import Arm
from icrl_dist.results.figures.selection import MissingError, Study
from icrl_dist.results.markup import CERTIFIED, Sheet, interval, number
from icrl_dist.results.statistics import Interval

UNDEFINED = "not defined"


def sheet(study: Study) -> Sheet:
    """One row for each place and policy version, and one for ICAG.  Raises ConfigError as ``findings.arms_of``."""
    variant = study.variant("icaa")
    versions = study.versions(variant) if variant else []
    if variant is None or len(versions) < 2:
        raise MissingError("table of ICAA", [f"{study.run(variant or 'icaa')}, evaluated after each round"])
    agents = [Choice("icaa", variant, f"T^{version}", version) for version in versions]
    agents.append(Choice("icag", study.variant("icag")))
    spots = [Spot(p) for p in study.levels(variant) if p in (0.0, *disturbed(study))] + [
        Spot(p, "unseen") for p in study.levels(variant, "unseen") if p
    ]
    rows: list[tuple[str, ...]] = []
    over: list[Arm] = []
    for spot in spots:
        arms = arms_of(study, "table of ICAA", [Term(1.0, agent, spot) for agent in agents])
        over += arms
        for index, row in enumerate(_rows(arms, [agent.label for agent in agents])):
            rows.append((f"{spot.p:g}{f', {spot.prior}' if spot.p else ''}" if index == 0 else "", *row))
    title = "ICAA: T^0, each round, and ICAG" + (f", setting {study.setting}" if study.setting else "")
    closing = f"Closed: (T^j - T^0) / (ICAG - T^0), {UNDEFINED} if the gap's interval contains 0 or lies below it"
    caption = f"Last episodes; {resampled(over)}. {closing}. {CERTIFIED}"
    return Sheet(
        title, ("p", "agent", "return", "less T^0", "less the one before", "closed", "certified"), tuple(rows), caption
    )


def _rows(arms: list[Arm], labels: list[str]) -> list[tuple[str, ...]]:
    scores, crossed = np.stack([arm.scores() for arm in arms]), arms[0].crossed
    count = len(arms)

    def numbers(of: Float64[np.ndarray, "R A S C"]) -> Float64[np.ndarray, "R K"]:
        means = statistics.mean(of)
        return np.concatenate([means, means - means[:, :1], np.diff(means, axis=1, prepend=0)], axis=1)

    found = statistics.estimate(scores, numbers, crossed)
    rows = []
    for i, label in enumerate(labels):
        share = closed(scores[[0, i, count - 1]], crossed) if 0 < i < count - 1 else None
        value, less_first, less_before = (found[i + offset * count] for offset in range(3))
        texts = [interval(value, "{:.2f}"), *("" if i == 0 else interval(of) for of in (less_first, less_before))]
        rows.append((label, *texts, "" if i in (0, count - 1) else _share(share), number(arms[i].worst())))
    return rows


def _share(share: Interval | None) -> str:
    return UNDEFINED if share is None else interval(share, "{:.0%}")


def closed(scores: Float64[np.ndarray, "3 S C E"], crossed: bool = True) -> Interval | None:
    """Share of the gap between T^0 and ICAG that T^j closed, from scores of T^0, T^j and ICAG; None if it is not defined.

    The interval is Fieller's (1954) for the ratio of X = T^j - T^0 to Y = ICAG - T^0: all r with (x - r y)^2 <= t^2
    Var(X - r Y), where the covariances are those of the bootstrap.  It is bounded exactly if the interval of Y excludes
    0; otherwise, and if Y is below 0, the share is not defined.
    """

    def both(of: Float64[np.ndarray, "R 3 S C"]) -> Float64[np.ndarray, "R 2"]:
        means = statistics.mean(of)
        return means[:, 1:] - means[:, :1]

    x, y = both(scores.mean(axis=-1)[None])[0]
    units = statistics.units(scores.shape[1:])
    if units < 2:
        return None
    drawn = statistics.bootstrap(scores, both, generator(0, RandomKey.RESULTS), crossed=crossed)
    (vx, vxy), (_, vy) = np.cov(drawn.T) * statistics.spread(units)
    a, b, c = y * y - vy, x * y - vxy, x * x - vx
    if y <= 0 or a <= 0:
        return None
    root = math.sqrt(max(0.0, b * b - a * c))
    return Interval(float(x / y), float((b - root) / a), float((b + root) / a))
