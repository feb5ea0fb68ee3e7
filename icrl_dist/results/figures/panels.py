"""The numbers of a figure's panels: values with intervals by series, computed from arms.  Pure functions of the arms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from icrl_dist.results import statistics
from icrl_dist.results.figures.reading import Arm
from icrl_dist.results.figures.selection import listed
from icrl_dist.results.names import AgentKey
from icrl_dist.results.returns import LAST
from icrl_dist.results.statistics import Interval

Kind = Literal["lines", "bars", "lost"]


class Point(NamedTuple):
    """One value of a series."""

    x: float | str
    """Episode (from 1), strength p, or the name of a group of bars."""
    value: Interval
    certified: float
    """The mean certified return of the same episodes; nan where it is not known."""


class Series(NamedTuple):
    """One curve, or the bars of one method."""

    name: str
    """What the legend calls it."""
    style: str
    """The key of its colour (``styles.STYLES``): a method, or the key of a reference agent."""
    rank: int
    """Which one it is of the series with the same style, from 0."""
    points: list[Point]


@dataclass(frozen=True)
class Panel:
    """One panel of a figure."""

    name: str
    """Such as ``3a``."""
    title: str
    kind: Kind
    x_label: str
    y_label: str
    series: list[Series]
    caption: str
    """What the intervals were resampled over, and what is missing or differs."""


class Entry(NamedTuple):
    """One arm, or the arms of one agent by p or by group, with its name and style."""

    name: str
    style: str
    arms: list[Arm]
    groups: list[str] = []  # noqa: RUF012  # never changed
    """The names of the arms' groups of bars."""


def _means(scores: Float64[np.ndarray, "R A S C"]) -> Float64[np.ndarray, "R A"]:
    return statistics.mean(scores)


def means(arms: Sequence[Arm], last: int = LAST) -> list[Interval]:
    """Mean return over the last episodes of each arm, with its interval; arms have equal shapes."""
    return statistics.estimate(np.stack([arm.scores(last) for arm in arms]), _means, arms[0].crossed)


def by_episode(entries: Sequence[Entry]) -> list[Series]:
    """The mean return of each online episode, of the first arm of each entry."""
    found = []
    for entry in entries:
        (arm,) = entry.arms
        values = statistics.estimate(np.moveaxis(arm.returns, 3, 0), _means, arm.crossed)
        worst = arm.certified.mean(axis=(0, 1, 2))
        points = [Point(n + 1, value, float(worst[n])) for n, value in enumerate(values)]
        found.append(Series(entry.name, entry.style, 0, points))
    return ranked(found)


def against_p(entries: Sequence[Entry], last: int) -> list[Series]:
    """The mean return of the last episodes against p; the arms of an entry are those of one agent by p."""
    found = []
    for entry in entries:
        values = means(entry.arms, last)
        points = [Point(arm.key.p, value, arm.worst(last)) for arm, value in zip(entry.arms, values, strict=True)]
        found.append(Series(entry.name, entry.style, 0, points))
    return ranked(found)


def bars(entries: Sequence[Entry], last: int = LAST) -> list[Series]:
    """A bar for each arm of an entry, in the group of its name."""
    found = []
    for entry in entries:
        values = means(entry.arms, last)
        points = [Point(*of) for of in zip(entry.groups, values, [arm.worst(last) for arm in entry.arms], strict=True)]
        found.append(Series(entry.name, entry.style, 0, points))
    return ranked(found)


def lost(entries: Sequence[Entry], last: int = LAST) -> list[Series]:
    """Three values of each agent: ``undisturbed``, ``disturbed``, and ``lost``, their difference in pairs.

    The arms of an entry are those at p = 0 and at the p of the disturbance.
    """
    found = []
    for entry in entries:
        scores = np.stack([arm.scores(last) for arm in entry.arms])
        values = statistics.estimate(scores, _lost, entry.arms[0].crossed)
        worst = [arm.worst(last) for arm in entry.arms]
        names = ("undisturbed", "disturbed", "lost")
        points = [Point(*of) for of in zip(names, values, (*worst, worst[0] - worst[1]), strict=True)]
        found.append(Series(entry.name, entry.style, 0, points))
    return ranked(found)


def _lost(scores: Float64[np.ndarray, "R 2 S C"]) -> Float64[np.ndarray, "R 3"]:
    before, after = np.moveaxis(statistics.mean(scores), -1, 0)
    return np.stack([before, after, before - after], axis=-1)


def ranked(series: Sequence[Series]) -> list[Series]:
    """The series with their ranks among those of equal style; an exact agent and its ``-committed`` have one style."""
    styles = [one.style.removesuffix("-committed") for one in series]
    return [one._replace(rank=styles[:i].count(style)) for i, (one, style) in enumerate(zip(series, styles, strict=True))]


def resampled(arms: Sequence[Arm], last: int = LAST) -> str:
    """What the intervals of some arms were resampled over, for a caption: seeds, splits, tasks, evaluations, adversaries."""
    arm = next((one for one in arms if one.key.p > 0), arms[0])
    trainings, tasks, evaluations, episodes = arm.returns.shape
    draws = max(len(np.unique(here)) for training in arm.adversaries for here in training)
    over = statistics.resampled(trainings, tasks, evaluations, min(last, episodes), draws)
    whole = "" if arm.crossed else "; each training is drawn with all its tasks, which are its own"
    splits = len({part.split_seed for part in arm.parts})
    each = f"{draws} adversary draw{'' if draws == 1 else 's'} a task"
    shared = " (shared by trainings; each should have its own)" if arm.shared_splits else ""
    text = f"{over}; training seeds {listed(arm.seeds)}, {statistics.counted(splits, 'split')} of the tasks{shared}, "
    return f"{text}{each}{whole}"


def with_note(panel: Panel, note: str) -> Panel:
    """The panel with one more sentence in its caption."""
    return replace(panel, caption=f"{panel.caption}. {note}") if note else panel


def is_reference(style: str) -> bool:
    """Whether a style is that of a reference agent."""
    return style in ("oracle", "random") or style.startswith("exact:")


def data(panel: Panel) -> dict[str, Any]:
    """The panel as JSON values; None for unknown numbers."""
    series = [
        {
            "name": one.name,
            "style": one.style,
            "points": [
                {
                    "x": point.x,
                    **{name: plain(number) for name, number in point.value._asdict().items()},
                    "certified": plain(point.certified),
                }
                for point in one.points
            ],
        }
        for one in panel.series
    ]
    texts = {name: getattr(panel, name) for name in ("name", "title", "kind", "x_label", "y_label", "caption")}
    return texts | {"series": series}


def plain(value: float) -> float | None:
    """A JSON value: None for nan."""
    return None if math.isnan(value) else value


def version_of(arm: Arm) -> int | None:
    """The policy version of an arm; None of a reference agent."""
    return int(arm.key.agent[1:]) if AgentKey(arm.key.agent).is_model else None
