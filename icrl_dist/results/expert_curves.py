"""Learning curves of a run's SAC experts, from the episodes of their training that the cache holds."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.run import Run
from icrl_dist.experts import standing
from icrl_dist.experts.cache import History, training_episodes
from icrl_dist.experts.standing import Standing
from icrl_dist.problems import registry
from icrl_dist.results import run_experts
from icrl_dist.results.evaluate import parameters
from icrl_dist.results.figures.panels import Panel, Point, Series, ranked
from icrl_dist.results.markup import Sheet, number
from icrl_dist.results.run_experts import Wanted
from icrl_dist.results.statistics import Interval
from icrl_dist.types import NULL

PARTS = 20
"""Parts of equal length into which a training is divided; a curve has one value for each."""
TITLE = "Learning curves of SAC experts"


@dataclass(frozen=True, eq=False)
class Curve:
    """The training of one expert."""

    of: Wanted
    steps: Float64[np.ndarray, " T"]
    """Environment steps at the end of each part."""
    returns: Float64[np.ndarray, " T"]
    """Mean return of the recorded training episodes in each part; nan for a part without one."""
    episodes: tuple[int, ...]
    """How many these are."""
    standing: Standing | None
    """What its mean action earns after the training; None where a scripted policy acts then."""


def curve(of: Wanted, history: History, acts: bool) -> Curve:
    """The curve of an expert; ``acts``: whether it acts in the history's episodes after the training.

    Recorded episodes count as evenly spaced, so those after an episode whose simulation diverged are placed a little early.
    """
    whole = training_episodes(of.horizon, of.sac)
    parts, returns = min(PARTS, whole), history.rewards.sum(axis=1, dtype=np.float64)
    at = np.linspace(0, whole - 1, len(returns)).round().astype(int) * parts // whole
    counts = np.bincount(at, minlength=parts)
    sums = np.bincount(at, returns, minlength=parts)
    means = np.where(counts, sums / np.maximum(counts, 1), np.nan)
    row = [(of.task, of.number)]
    found = standing.of(row, [of.variation], [history], of.sac)[0] if acts else None
    steps = np.arange(1, parts + 1) * (whole * of.horizon / parts)
    return Curve(of, steps, means, tuple(counts.tolist()), found)


def panel(curves: Sequence[Curve], caption: str) -> Panel:
    """Mean and minimum over tasks and adversaries, of the undisturbed and of the disturbed experts."""
    series = []
    for style in ("undisturbed", "disturbed"):
        chosen = [one for one in curves if (one.of.variation.adversary == NULL) == (style == "undisturbed")]
        if not chosen:
            continue
        values = np.stack([one.returns for one in chosen])
        filled = ~np.isnan(values).all(axis=0)
        for name, over in (("mean", np.nanmean), ("minimum", np.nanmin)):
            numbers = over(values[:, filled], axis=0)
            points = zip(chosen[0].steps[filled].tolist(), numbers.tolist(), strict=True)
            known = [Point(step, Interval(value, np.nan, np.nan), np.nan) for step, value in points]
            series.append(Series(f"{style}, {name}", style, 0, known))
    return Panel(
        "experts",
        f"{len(curves)} experts",
        "lines",
        "environment steps",
        "return of a training episode",
        ranked(series),
        caption,
    )


def sheet(curves: Sequence[Curve], caption: str) -> Sheet:
    """One row for each expert: the first and the last part of its training, and what its mean action earns after it."""
    columns = ("expert", "task", "adversary", "first part", "last part", "mean action", "asked for", "")
    return Sheet(TITLE, columns, tuple(map(_cells, curves)), caption)


def _cells(one: Curve) -> tuple[str, ...]:
    texts = ", ".join(f"{name} {value:g}" for name, value in one.of.variation.task.params if isinstance(value, float))
    ends = (number(float(one.returns[place])) for place in (0, -1))
    if (found := one.standing) is None:
        return one.of.name, texts, one.of.variation.adversary.kind, *ends, "-", "-", ""
    asked = f"{found.least:g}" if found.least else "-"
    verdict = "failed" if found.failed else ""
    return one.of.name, texts, one.of.variation.adversary.kind, *ends, number(found.earned), asked, verdict


def caption(curves: Sequence[Curve], missing: int) -> str:
    """What the numbers are, the share of experts that failed, and how many are missing."""
    standings = [one.standing for one in curves if one.standing is not None]
    failed = standing.listed(standings)
    texts = [
        f"Returns of recorded training episodes, whose actions are sampled, as means over {len(curves[0].steps)} parts of the "
        "training",
        "`mean action`: mean return of the episodes after the training" if standings else "",
        failed or ("no expert returns less than is asked for" if any(one.least for one in standings) else ""),
        f"{missing} experts of the run are not in the cache of this node" if missing else "",
    ]
    return ". ".join(text for text in texts if text)


def csv_rows(curves: Sequence[Curve]) -> str:
    """All curves, one line for each expert and part of its training; an unknown return is empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["expert", "task", "adversary_family", "adversary", "step", "return", "episodes"])
    for one in curves:
        variation = one.of.variation
        texts = [parameters(variation.task), variation.adversary.kind, parameters(variation.adversary)]
        for step, value, count in zip(one.steps, one.returns, one.episodes, strict=True):
            writer.writerow([one.of.name, *texts, f"{step:g}", f"{value:.6g}" if count else "", count])
    return out.getvalue()


def curves(run: Run, what: str) -> tuple[list[Curve], int]:
    """The curves of a run's experts in the cache of this node, and how many experts it does not hold.

    Raises ConfigError, with the command that trains them, if it holds none; ``what``: the run folder, for messages.
    """
    wanted = [one for job in run_experts.wanted(run) for one in job]
    acts = standing.labels_come_from_experts(registry.of(run))
    loaded = ((one, one.load()) for one in wanted)
    found = [curve(one, history, acts) for one, history in loaded if history is not None]
    if not found:
        run_experts.kept(run, what)
    return found, len(wanted) - len(found)
