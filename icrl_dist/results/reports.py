"""What an evaluation gives its user: rows, tables, a summary, and the files of its report."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions
from rich.jupyter import JupyterMixin
from rich.table import Table
from rich.text import Text

from icrl_dist.config.run import Run
from icrl_dist.console.terminal import PlainConsole
from icrl_dist.problems import registry
from icrl_dist.results import attack, plots, summaries
from icrl_dist.results import worst as worst_suite
from icrl_dist.results.returns import Returns, returns
from icrl_dist.results.rows import keeping
from icrl_dist.results.tables import experts_table, gap_table, kl_table, returns_table
from icrl_dist.storage.files import StoreError, write_json

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Evaluation(JupyterMixin):
    """The result of one evaluation.  A notebook shows its tables, and so does ``print``."""

    rows: pd.DataFrame = field(repr=False)
    """The new result rows, one per evaluated episode; docs/data.md explains the columns."""
    tables: tuple[Table, ...] = field(repr=False)
    """The tables that the command line prints."""
    notes: tuple[str, ...] = field(repr=False)
    """Lines below the tables."""
    summary: dict[str, Any] = field(repr=False)
    """The numbers of the tables as JSON values: what ``icrl-dist evaluate --json`` prints."""

    @property
    def figure(self) -> Path | None:
        """The figure of the report, a PNG file; None for an evaluation without one, and if it could not be stored."""
        return Path(self.summary["figure"]) if "figure" in self.summary else None

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table | Text]:
        yield from self.tables
        yield from map(Text, self.notes)

    def __str__(self) -> str:
        console = PlainConsole(file=io.StringIO(), width=120, soft_wrap=True)
        with console.capture() as captured:
            console.print(self)
        return captured.get().rstrip("\n")


def online(run: Run, report: Path, frame: pd.DataFrame, unstored: list[StoreError] | None = None) -> Evaluation:
    """The evaluation with these rows of suite ``online``.

    Writes the numbers to ``report``.json, the figure to ``report``.png; ``unstored`` as in ``rows.record``.
    """
    numbers, scores, found = summaries.result_rows(frame), summaries.surprise(frame), returns(frame)
    _, tasks, evaluations, _ = found[0].returns.shape
    title = f"{run.method.upper()} on {registry.of(run).title(tasks)}, {evaluations} seeds"
    stored = _stored(report, numbers, lambda path: plots.adaptation(numbers, path, title), unstored)
    surprises = [
        f"surprise at the end, p = {p}: median {score['median']:.2f}, above 1 in {score['above_1']:.0%}"
        for p, score in scores.items()
    ]
    return Evaluation(
        frame,
        (returns_table(frame, f"Return by online episode: {title}"),),
        (*_diverged(found), *surprises, *_notes(stored, unstored)),
        {**summaries.adaptation(frame), "surprise": scores, "rows": numbers, **stored},
    )


def _stored(report: Path, numbers: object, draw: Callable[[Path], Path], unstored: list[StoreError] | None) -> dict[str, str]:
    """Write the files of a report; returns the path of its figure as an entry of the summary."""
    with keeping(unstored):
        write_json(report.with_name(f"{report.name}.json"), numbers)
    with keeping(unstored):
        return {"figure": str(draw(report.with_name(f"{report.name}.png")))}
    return {}


def _notes(stored: Mapping[str, str], unstored: Sequence[StoreError] | None) -> Iterator[str]:
    yield from (f"{name} {path}" for name, path in stored.items())
    if unstored:
        others = f"; nor could {len(unstored) - 1} other files" if len(unstored) > 1 else ""
        yield f"not stored: {unstored[0]}{others}"


def _diverged(found: Sequence[Returns]) -> list[str]:
    return [
        f"{one.name}, p = {one.p:g}: the simulation diverged in {one.diverged} of {one.returns.size} episodes; "
        "their return up to that step counts"
        for one in found
        if one.diverged
    ]


def offline(run: Run, frame: pd.DataFrame, unstored: Sequence[StoreError] = ()) -> Evaluation:
    """The evaluation with these rows of suite ``offline``."""
    found = returns(frame)
    title = registry.of(run).title(found[0].returns.shape[1])
    table = returns_table(frame, f"One episode given data collected before: {title}")
    notes = (*_diverged(found), *_notes({}, unstored))
    return Evaluation(frame, (table,), notes, {"rows": summaries.result_rows(frame)})


def attacked(run: Run, report: Path, frame: pd.DataFrame, draws: int, unstored: list[StoreError] | None = None) -> Evaluation:
    """The evaluation with these rows of suite ``attack``, whose numbers are written to ``report``.json."""
    found = attack.summary(frame)
    with keeping(unstored):
        write_json(report.with_name(f"{report.name}.json"), found)
    title = f"One episode under attack: {run.method.upper()}, {registry.of(run).title(registry.of(run).evaluated_count)}"
    return Evaluation(
        frame, (attack.table(run, found, title, draws),), tuple(_notes({}, unstored)), {"draws": draws, "attack": found}
    )


def worst(
    run: Run, report: Path, frame: pd.DataFrame, adversaries: int, steps: int, unstored: list[StoreError] | None = None
) -> Evaluation:
    """The evaluation with these rows of suite ``worst``, whose numbers are written to ``report``.json."""
    found = worst_suite.summary(frame)
    with keeping(unstored):
        write_json(report.with_name(f"{report.name}.json"), found)
    title = f"Adversaries trained against each agent: {registry.of(run).title(registry.of(run).evaluated_count)}"
    table = worst_suite.table(found, title, adversaries, steps, run.evaluate.episodes)
    summary = {"adversaries": adversaries, "steps": steps, "worst": found}
    return Evaluation(frame, (table,), tuple(_notes({}, unstored)), summary)


def posterior(
    run: Run, report: Path, frame: pd.DataFrame, found: dict[str, Any], unstored: list[StoreError] | None = None
) -> Evaluation:
    """The evaluation with these rows of suite ``posterior`` and the distances ``found``.

    Writes the distances to ``report``.json, the figure to ``report``.png; ``unstored`` as in ``rows.record``.  The
    summary leaves out the curves.
    """
    problem = registry.of(run)
    title = f"{run.method.upper()} compared with the exact posterior: {problem.title(len(problem.evaluated))}"
    stored = _stored(report, found, lambda path: plots.agreement(found, path, title), unstored)
    assert problem.posterior is not None, "``check_suite`` refuses problems without one"
    tables = [
        kl_table(found, prior, f"KL(exact || model) in nats, where {meaning}")
        for prior, meaning in problem.posterior.priors.items()
    ]
    adversary = f"{run.evaluate.prior} adversary, {run.evaluate.episodes} episodes, {run.evaluate.seeds} seeds"
    tables.append(gap_table(found, f"Online return by Algorithm 1 compared with the exact agent's: {adversary}"))
    summary = {key: value for key, value in found.items() if not key.endswith("_curves")} | stored
    return Evaluation(frame, tuple(tables), tuple(_notes(stored, unstored)), summary)


def experts(frame: pd.DataFrame, notes: tuple[str, ...] = ()) -> Evaluation:
    """The evaluation with these rows of suite ``experts``."""
    found = summaries.experts(frame)
    return Evaluation(frame, (experts_table(found, frame["agent"].iloc[0]),), notes, {"experts": found})
