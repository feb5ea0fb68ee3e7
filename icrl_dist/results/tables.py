"""Tables of results for the terminal, computed from result rows."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions
from rich.table import Table

from icrl_dist.config.run import ConfigError
from icrl_dist.results import comparison, statistics, summaries
from icrl_dist.results.returns import LAST, Returns, returns
from icrl_dist.results.statistics import Interval

if TYPE_CHECKING:
    import pandas as pd


class NarrowTable(Table):
    """A table that leaves out columns where it would be wider than the console; the others are never cut."""

    spare: tuple[str, ...] = ()
    """Headers of the columns that may be left out, the first one first."""

    def add_column(self, *arguments: Any, **options: Any) -> None:
        super().add_column(*arguments, **{"overflow": "fold", **options})

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Any]:
        shown = copy.copy(self)
        for header in self.spare:
            if console.measure(shown, options=options.update(max_width=10_000)).maximum <= options.max_width:
                break
            shown.columns = [column for column in shown.columns if column.header != header]
        yield from Table.__rich_console__(shown, console, options)


def returns_table(frame: pd.DataFrame, title: str) -> Table:
    """Mean return by online episode, one row per agent and p, with the 95% interval of the last column.

    ``frame``: result rows of one suite.  The last column is the return of the last episodes as a share of the first
    reference that is a ceiling (oracle, scripted policy or experts), or of the exact optimum if there is none; without
    either it is that return itself.  Raises ConfigError for rows that are no evaluations of equal size.
    """
    found = returns(frame)
    trainings, tasks, evaluations, episodes = _shape(found)
    shown, last = [e for e in (1, 2, 3, 5, 10, 20, 30, 40) if e <= episodes], min(LAST, episodes)
    over = statistics.resampled(trainings, tasks, evaluations, last, max(one.draws for one in found))
    caption = f"[...]: {over}" if statistics.units((trainings, tasks, evaluations)) > 1 else over
    worst = {(one.p, one.agent): worst_case(one, last) for one in found} if any_certified(found, last) else {}
    caption += f".  {CERTIFIED}" if worst else ""
    table = NarrowTable(title=title, title_justify="left", caption=caption, caption_justify="left")
    table.spare = tuple(f"ep {e}" for e in (30, 3, 20, 5, 2, 10, 40))
    for name in ("p", "agent", *(f"ep {e}" for e in shown), f"last {last}"):
        table.add_column(name, justify="left" if name == "agent" else "right")
    best, estimates = summaries.ceilings(found, last), summaries.intervals(found, last)
    if best:
        table.add_column(f"of {next(iter(best.values())).name}", justify="right")
    if worst:
        table.add_column("certified", justify="right")
    for before, one in zip([None, *found], found, strict=False):
        value, share = estimates[one.p, one.agent]
        mean, _ = one.by_episode()
        table.add_row(
            "" if before is not None and before.p == one.p else f"{one.p:g}",
            one.name,
            *(f"{mean[e - 1]:.1f}" for e in shown),
            _with_interval(value, "{:.1f}") if share is None else f"{value.value:.1f}",
            *([] if share is None else [_with_interval(share, "{:.0%}")]),
            *([worst[one.p, one.agent]] if worst else []),
        )
    return table


CERTIFIED = (
    "certified: mean expected return of these episodes, each given its context, against the worst adversary that overrides "
    "actions with probability p (exact; it covers neither wind nor permuted controls, nor an adversary that also acted while "
    "the context was collected); estimated: no such value, the worst of the sampled adversaries of each task instead; -: only "
    "one was sampled"
)
"""Caption of the column ``certified``."""


def any_certified(found: Sequence[Returns], last: int) -> bool:
    """Whether the column ``certified`` is shown: whether any agent has such a value."""
    return any(one.certificate(last) is not None for one in found)


def worst_case(one: Returns, last: int) -> str:
    """The certified return, or the worst of several sampled adversaries, labelled ``estimated``; ``-`` with a single one."""
    certified = one.certificate(last)
    if certified is not None:
        return f"{certified:.1f}"
    return f"{one.worst_sampled(last):.1f} estimated" if one.p == 0 or one.draws > 1 else "-"


def _shape(found: Sequence[Returns]) -> tuple[int, ...]:
    """Trainings, tasks, evaluations and episodes of all the rows of a table, whose caption names them once."""
    for one in found:
        if one.returns.shape != found[0].returns.shape:
            shapes = ["{} trainings, {} tasks, {} evaluations, {} episodes".format(*of.returns.shape) for of in (found[0], one)]
            raise ConfigError(
                f"one table needs evaluations of equal size: {found[0].name} at p = {found[0].p:g} has {shapes[0]}, and "
                f"{one.name} at p = {one.p:g} has {shapes[1]}; choose rows of one p, or of one "
                "evaluation in read_results(..., all=True)"
            )
    return found[0].returns.shape


def _with_interval(of: Interval, form: str) -> str:
    if math.isnan(of.value):
        return "-"
    value, low, high = (form.format(number) for number in of)
    return value if math.isnan(of.low) else f"{value} [{low.removesuffix('%')}, {high.removesuffix('%')}]"


def _range(of: Interval, form: str) -> str:
    return "-" if math.isnan(of.low) else f"{form.format(of.low)} .. {form.format(of.high)}"


def compare(*frames: pd.DataFrame, names: Sequence[str] = (), last: int = LAST) -> Table:
    """The newest model of each later frame compared with that of the first, at every p that both have.

    ``frames``: result rows, each of the trainings of one method (``icrl_dist.read_results``); ``names``: what the table
    calls them, by default the names of their models; ``last``: the last episodes of an evaluation, whose mean return is
    compared.  A notebook shows the table, and so does ``rich.print``.  An effect whose 95% interval contains the value of
    equal agents is worded "not shown".  Raises ConfigError for rows that cannot be paired (``comparison.compare``).
    """
    if len(frames) < 2:
        raise ConfigError(f"compare: {len(frames)} frames were given; give at least two")
    if names and len(names) != len(frames):
        raise ConfigError(f"compare: {len(names)} names were given for {len(frames)} frames; give one for each, or none")
    arms = [comparison.newest_model(frame) for frame in frames]
    called = list(names) or [arm[0].name for arm in arms]
    base = arms[0]
    trainings, tasks, evaluations, episodes = _shape(base)
    draws = max(one.draws for arm in arms for one in arm)
    over = statistics.resampled(trainings, tasks, evaluations, min(last, episodes), draws)
    table = NarrowTable(
        title=f"Return of the last {min(last, episodes)} episodes, compared with {called[0]}",
        title_justify="left",
        caption=f"{over}; the same resamples for both; for the minimum, tasks are not resampled.  `not shown`: the interval "
        "contains the value of equal agents, or there is none",
        caption_justify="left",
    )
    for name in ("p", "statistic", called[0], "compared", "its value", "effect", "95%", "verdict"):
        table.add_column(name, justify="left" if name in ("statistic", "compared", "verdict") else "right")
    for name, arm in zip(called[1:], arms[1:], strict=True):
        partners = {one.p: one for one in arm}
        if not (shared := [one for one in base if one.p in partners]):
            raise ConfigError(f"compare: {called[0]} and {name} were evaluated at no p in common; evaluate both at one p")
        for one in shared:
            rows = comparison.compare(one, partners[one.p], last)
            for row in rows:
                form = _FORMS.get(row.statistic, "{:+.2f}")
                single = ["" if value is None else f"{value:.2f}" for value in (row.first, row.second)]
                effect = ["-" if math.isnan(row.effect.value) else form.format(row.effect.value), _range(row.effect, form)]
                cells = (_STATISTICS.get(row.statistic, row.statistic), single[0], name, single[1], *effect)
                table.add_row(f"{row.p:g}" if row is rows[0] else "", *cells, row.verdict, end_section=row is rows[-1])
    return table


_FORMS = {"ratio": "{:+.1%}", "improvement": "{:.0%}"}
_STATISTICS = {"ratio": "ratio of means, less 1", "improvement": "probability of improvement"}


def experts_table(rows: Sequence[Mapping[str, Any]], agent: str = "expert") -> Table:
    """Return of each expert's first and last recorded episode, one row per variation; ``rows``: ``summaries.experts``.

    ``agent``: their key in result rows; robust policies have no recorded training, but episodes after it.
    """
    what = "SAC experts: return" if agent == "expert" else f"{agent.upper()} policies, undisturbed after training: return"
    table = NarrowTable(title=f"{what} of the first and of the last recorded episode", title_justify="left")
    for name in ("task", "adversary", "first", "last"):
        table.add_column(name, justify="left" if name in ("task", "adversary") else "right")
    for row in rows:
        task = ", ".join(f"{name} {value:g}" for name, value in row["task"].items()) or "-"
        table.add_row(task, row["adversary"], *(f"{value:.1f}" for value in row["returns"]))
    return table


def kl_table(report: Mapping[str, Any], suffix: str, title: str) -> Table:
    """Divergence from the exact posterior under one prior, one row per kind of context and p, and their mean.

    ``suffix``: the part of the report's keys that stands for the prior.
    """
    contexts = report[f"kl_nats{suffix}_cells"][0]["contexts"]
    over = f"{contexts} contexts of each kind and p"
    caption = f"one training: +- is the standard error over {over}; it says nothing about other training seeds"
    table = NarrowTable(title=title, title_justify="left", caption=caption, caption_justify="left")
    for name in ("goals", "context", "p", "KL", "+-", "goal met", "not met", "met in"):
        table.add_column(name, justify="left" if name in ("goals", "context") else "right")
    for name, goals in ((f"kl_nats{suffix}", "trained on"), (f"kl_heldout{suffix}", "never trained on")):
        for index, row in enumerate(report[f"{name}_cells"]):
            numbers = [_nats(row[key]) for key in ("kl", "standard_error", "goal_met", "goal_unmet")]
            table.add_row("" if index else goals, row["kind"], f"{row['p']:g}", *numbers, f"{row['met']:.0%}")
        whole = [_nats(report[f"{name}{part}"]) for part in ("", "_standard_error", "_goal_met", "_goal_unmet")]
        table.add_row("", "all", "", *whole, "", style="bold", end_section=True)
    return table


def _nats(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def gap_table(report: Mapping[str, Any], title: str) -> Table:
    """Online return relative to the exact agent's, one row per set of goals and p, with 95% intervals.

    ``report``: holds a table of ``posterior.gap`` by p for each set of goals.
    """
    first = next(iter(report["paper_gap"].values()))
    draws = max(row["draws"] for row in report["paper_gap"].values())
    caption = (
        f"{statistics.resampled(1, first['tasks'], first['seeds'], first['episodes'], draws)}; the same resamples for both"
    )
    table = NarrowTable(title=title, title_justify="left", caption=caption, caption_justify="left")
    for name in ("goals", "p", "model", "exact", "gap", "95%", "difference"):
        table.add_column(name, justify="left" if name in ("goals", "difference") else "right")
    for name, goals in (("paper_gap", "never trained on"), ("paper_gap_train", "trained on")):
        for index, (p, row) in enumerate(report[name].items()):
            gap = Interval(row["gap"], *(math.nan if row[side] is None else row[side] for side in ("low", "high")))
            last = index + 1 == len(report[name])
            cells = (f"{row['model']:.1f}", f"{row['exact']:.1f}", f"{gap.value:+.1%}", _range(gap, "{:+.1%}"))
            table.add_row("" if index else goals, p, *cells, gap.verdict(), end_section=last)
    return table
