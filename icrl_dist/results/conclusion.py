"""The end of a training in four rows and a sentence: what the newest model is worth in tasks that it was not trained on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from icrl_dist.results import comparison, statistics, summaries
from icrl_dist.results.returns import LAST, Returns, returns
from icrl_dist.results.tables import CERTIFIED, any_certified, worst_case

if TYPE_CHECKING:
    import pandas as pd

_WORDS = {"higher": "a gain", "lower": "a loss", "not shown": "a gain is not shown"}


def table(frame: pd.DataFrame, title: Callable[[int], str]) -> Table:
    """The newest model, T^0, the random policy and what returns are a share of, at the largest p; missing ones have no row.

    ``frame``: result rows of the suite ``online``; ``title``: names so many tasks.  The table fits into 80 columns.
    """
    found = _chosen(frame)
    every = returns(frame)
    episodes = min(LAST, found[0].returns.shape[-1])
    estimates, best = summaries.intervals(every, episodes), summaries.ceilings(every, episodes)
    trainings, tasks, evaluations, _ = found[0].returns.shape
    certified = any_certified(found, episodes)
    shown = Table(
        title=f"{title(tasks)}, p = {found[0].p:g}: mean return of the last {episodes} episodes",
        title_justify="left",
        caption=statistics.resampled(trainings, tasks, evaluations, episodes, max(one.draws for one in found))
        + (f".  {CERTIFIED}" if certified else ""),
        caption_justify="left",
    )
    of = next((best[one.p, one.agent].name for one in found if (one.p, one.agent) in best), "")
    for name in ("agent", "return", "95%", *([f"of {of}"] if of else []), *(["certified"] if certified else [])):
        shown.add_column(name, justify="left" if name == "agent" else "right", overflow="fold")
    for one in found:
        value, share = estimates[one.p, one.agent]
        shares = [] if not of else ["-" if share is None or math.isnan(share.value) else f"{share.value:.0%}"]
        interval = "-" if math.isnan(value.low) else f"{value.low:.2f} .. {value.high:.2f}"
        worst = [worst_case(one, episodes)] if certified else []
        shown.add_row(one.name, f"{value.value:.2f}", interval, *shares, *worst)
    return shown


def sentence(frame: pd.DataFrame) -> str:
    """Whether the newest model gained over T^0 at the largest p; of a run without adapted versions, over the random policy."""
    found = _chosen(frame)
    newest, others = found[0], [one for one in found[1:] if one.agent.agent in ("t0", "random")]
    if not newest.agent.is_model or not others:
        return ""
    effect = next(row for row in comparison.compare(others[0], newest) if row.statistic == "mean")
    name = newest.name.partition(" (")[0]
    low, high = effect.effect.low, effect.effect.high
    numbers = f"{effect.effect.value:+.2f}" + ("" if math.isnan(low) else f" (95% interval {low:+.2f} .. {high:+.2f})")
    text = f"{name} compared with {others[0].name} at p = {newest.p:g}: {_WORDS[effect.verdict]}, {numbers}"
    if len(newest.training_seeds) > 1:
        return text
    return f"{text}, in this training; one training seed says nothing about other seeds"


def _chosen(frame: pd.DataFrame) -> list[Returns]:
    """At the largest p: the newest model by its own rule, T^0 by the same rule, random, and the first ceiling."""
    every = returns(frame)
    largest = max(one.p for one in every)
    here = [one for one in every if one.p == largest]
    models = [one for one in here if one.agent.is_model]
    rest = [one for one in here if one.agent.agent == "random"] + [one for one in here if one.ceiling]
    if not models:
        return _first(rest or here, 4)
    newest = max(models, key=lambda one: (int(one.agent.agent[1:]), one.agent.deployment != "paper"))
    first = [one for one in models if one.agent.agent == "t0" and one is not newest and newest.agent.agent != "t0"]
    return [newest, *sorted(first, key=lambda one: one.agent.deployment != newest.agent.deployment)[:1], *_first(rest, 2)]


def _first(found: Sequence[Returns], count: int) -> list[Returns]:
    return list({one.agent: one for one in found}.values())[:count]
