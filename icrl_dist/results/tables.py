"""Tables of results for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from icrl_dist.results.evaluate import Result


def returns_table(results: Sequence[Result], title: str) -> Table:
    """Mean return by online episode, one row per agent and p.

    The last column is the return of the last episodes as a share of the first reference that is a ceiling
    (oracle, scripted policy or experts), or of the exact optimum if there is none.
    """
    episodes = results[0].returns.shape[2]
    shown = [e for e in (1, 2, 3, 5, 10, 20, 30, 40) if e <= episodes]
    last = min(5, episodes)
    table = Table(title=title, title_justify="left")
    table.add_column("p", justify="right")
    table.add_column("agent")
    for e in shown:
        table.add_column(f"ep {e}", justify="right")
    table.add_column(f"last {last}", justify="right")
    ceiling_agents = [r.agent for r in results if r.ceiling]
    best = ceiling_agents[0] if ceiling_agents else "oracle" if results[0].optimum is not None else ""
    if best:
        table.add_column(f"of {best}", justify="right")
    ceilings = {r.p: r.last(last) for r in results if r.agent == best}
    for result in results:
        mean = result.returns.mean(axis=(0, 1))
        if not ceiling_agents and result.optimum is not None:
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
    """Return of each expert's first and last recorded episode, one row per variation."""
    table = Table(title="SAC experts: return of the first and of the last recorded episode", title_justify="left")
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
    table = Table(title=title, title_justify="left")
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
    """Online return relative to the exact agent's, one row per set of goals and p, with 95% intervals."""
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
