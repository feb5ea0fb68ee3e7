"""What a run shows in the terminal: a bar a stage, events between them, a table at the end."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from icrl_dist.results.evaluate import Result

_PERIOD_S = 10.0


class Display:
    """Shows a run's events; without a terminal it prints a line a stage and every ten seconds."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._bars: dict[str, TaskID] = {}
        self._printed: dict[str, tuple[float, bool]] = {}
        columns = (
            TextColumn("{task.description:<26}"),
            BarColumn(24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(compact=True, elapsed_when_finished=False),
            TextColumn("{task.fields[info]}"),
        )
        self._progress = Progress(*columns, console=console)

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.console.is_terminal:
            self._progress.stop()

    def report(self, event: dict[str, Any]) -> None:
        """Show one event of the learner, the fleet or an evaluation."""
        kind = event["event"]
        if kind == "progress":
            self._stage(event)
        elif kind == "labels":
            self.console.print(
                f"  labels of round {event['round']}: {event['agreement']:.0%} optimal; return {event['label_return']:.1f}"
                f" in the trials that label, {event['context_return']:.1f} in those before, {event['optimum']:.1f} at best",
                highlight=False,
            )
        elif kind == "listening":
            where = f"learner on {event['host']} ({event['device']})"
            told = f"{where} listens at {event['endpoint']}, weights version {event['version']}"
            self.console.print(told, highlight=False, markup=False)
        elif kind in ("note", "worker", "alert", "crash", "quarantine", "released", "repaired", "interrupted"):
            self.console.print(event["text"], highlight=False, markup=False)

    def _stage(self, event: dict[str, Any]) -> None:
        name = _name(event)
        info = _info(event)
        done, total = event["step"], event["steps"]
        if self.console.is_terminal:
            if name not in self._bars:
                self._bars[name] = self._progress.add_task(name, total=total, info=info)
            self._progress.update(self._bars[name], completed=done, info=info)
            return
        when, ended = self._printed.get(name, (time.monotonic(), False))
        if not ended and (done == total or time.monotonic() - when >= _PERIOD_S or name not in self._printed):
            self._printed[name] = (time.monotonic(), done == total)
            if done or event.get("doing"):
                self.console.print(f"{name:<26} {done:>7}/{total:<7} {info}", highlight=False)


def _name(event: dict[str, Any]) -> str:
    if event["stage"] == "evaluate":
        return str(event["phase"])
    if event["stage"] == "fit":
        return f"fit T^{event['version'] + 1}"
    return "contexts, D^0" if event["phase"] == "pretrain" else f"round {event['round']}: T^{event['version']} rolls out"


def _info(event: dict[str, Any]) -> str:
    if event["stage"] == "evaluate":
        return ""
    if event["stage"] == "fit":
        return f"loss {event['loss']:.3f}"
    drops = sum(event["drops"].values())
    dropped = f", {drops} dropped" if drops else ""
    acting = f", weights v{event['version']}, lag {event['lag']}" if event["phase"] == "adapt" else ""
    if event.get("doing"):
        return f"{event['workers']} workers{acting}{dropped}; {'; '.join(event['doing'])}"
    return f"{event['per_s']:.0f} trajectories/s, {event['workers']} workers{acting}{dropped}"


def returns_table(results: Sequence[Result], title: str) -> Table:
    """Mean return by online episode, a row an agent and p, the last column beside the optimum."""
    episodes = results[0].returns.shape[2]
    shown = [e for e in (1, 2, 3, 5, 10, 20, 30, 40) if e <= episodes]
    last = min(5, episodes)
    table = Table(title=title, title_justify="left")
    table.add_column("p", justify="right")
    table.add_column("agent")
    for e in shown:
        table.add_column(f"ep {e}", justify="right")
    table.add_column(f"last {last}", justify="right")
    present = [r.agent for r in results if r.ceiling]
    best = present[0] if present else "oracle" if results[0].optimum is not None else ""
    if best:
        table.add_column(f"of {best}", justify="right")
    ceilings = {r.p: r.last(last) for r in results if r.agent == best}
    for result in results:
        mean = result.returns.mean(axis=(0, 1))
        if not present and result.optimum is not None:
            ceilings[result.p] = float(np.mean(result.optimum))
        cells = [f"{mean[e - 1]:.1f}" for e in shown]
        first = results[max(0, results.index(result) - 1)].p == result.p and results.index(result) > 0
        table.add_row(
            "" if first else f"{result.p:g}",
            result.agent,
            *cells,
            f"{result.last(last):.1f}",
            *([_share(result.last(last), ceilings[result.p])] if best else []),
        )
    return table


def _share(value: float, ceiling: float) -> str:
    return f"{value / ceiling:.0%}" if ceiling else "-"


def experts_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Returns of each expert's first and last recorded episode, a row a variation."""
    table = Table(title="SAC experts: return of the first and of the last episode that was recorded", title_justify="left")
    for name in ("task", "adversary", "first", "last"):
        table.add_column(name, justify="left" if name in ("task", "adversary") else "right")
    for row in rows:
        told = ", ".join(f"{name} {value:g}" for name, value in row["task"].items()) or "-"
        table.add_row(told, row["adversary"], *(f"{value:.1f}" for value in row["returns"]))
    return table


def kl_table(report: Mapping[str, Any], law: str, title: str) -> Table:
    """Divergence from the exact posterior by one law, a row a kind of context and p, and all of them together."""
    table = Table(title=title, title_justify="left")
    for name in ("goals", "context", "p", "KL", "+-", "goal met", "not met", "met in"):
        table.add_column(name, justify="left" if name in ("goals", "context") else "right")
    for name, goals in ((f"kl_nats{law}", "trained on"), (f"kl_heldout{law}", "never trained on")):
        for index, row in enumerate(report[f"{name}_cells"]):
            numbers = [_nats(row[key]) for key in ("kl", "standard_error", "goal_met", "goal_unmet")]
            table.add_row("" if index else goals, row["kind"], f"{row['p']:g}", *numbers, f"{row['met']:.0%}")
        whole = [_nats(report[f"{name}{part}"]) for part in ("", "_standard_error", "_goal_met", "_goal_unmet")]
        table.add_row("", "all", "", *whole, "", style="bold", end_section=True)
    return table


def _nats(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def gap_table(report: Mapping[str, Any], title: str) -> Table:
    """Online return over the exact agent's, a row a set of goals and p, with 95% intervals."""
    table = Table(title=title, title_justify="left")
    for name in ("goals", "p", "model", "exact", "gap", "95%"):
        table.add_column(name, justify="left" if name == "goals" else "right")
    for name, goals in (("paper_gap", "never trained on"), ("paper_gap_train", "trained on")):
        for index, (p, row) in enumerate(report[name].items()):
            interval = f"{row['low']:+.1%} .. {row['high']:+.1%}"
            last = index + 1 == len(report[name])
            cells = (f"{row['model']:.1f}", f"{row['exact']:.1f}", f"{row['gap']:+.1%}", interval)
            table.add_row("" if index else goals, p, *cells, end_section=last)
    return table
