"""Figures of evaluations, from numbers that are computed from result rows.

They are made without pyplot, so the backend and the open figures of the process stay as they are.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from icrl_dist.storage.files import atomic_write

COLORS = ("#1f6feb", "#8957e5", "#d29922", "#2da44e")
_EXACT = (
    ("#8c959f", (0, (1, 1.2))),
    ("#8c959f", "-."),
    ("#57606a", (0, (5, 1.5))),
    ("#57606a", "-"),
    ("#24292f", (0, (3, 1, 1, 1))),
)
_GOALS = {"kl_nats": ("goals trained on", "#2da44e"), "kl_heldout": ("goals never trained on", "#cf222e")}
_GAPS = ("paper_gap_train", "paper_gap")
_PRIORS = {"": "own adversaries", "_any": "any adversary"}


def adaptation(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> Path:
    """Return per online episode, one panel for each p (Figures 3b and 3d); exact agents are gray, the oracle is a line.

    ``rows``: of ``summaries.result_rows``.  Returns ``path``.  Raises StoreError if it cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    levels = sorted({row["p"] for row in rows})
    figure = Figure(figsize=(max(7.0, 4.6 * len(levels)), 4.2), layout="constrained")
    axes = figure.subplots(1, len(levels), sharey=True, squeeze=False)
    for axis, p in zip(axes[0], levels, strict=True):
        here = [row for row in rows if row["p"] == p]
        episodes = range(1, len(here[0]["episodes"]) + 1)
        for (color, dashes), row in zip(_EXACT, [r for r in here if _is_exact(r)], strict=False):
            axis.plot(episodes, row["episodes"], color=color, linestyle=dashes, label=row["agent"], linewidth=1.2)
        learned = [r for r in here if r["key"] != "oracle" and not _is_exact(r)]
        for color, row in zip(itertools.cycle(COLORS), learned, strict=False):
            error = [e or 0.0 for e in row["standard_error"]]
            low = [m - e for m, e in zip(row["episodes"], error, strict=True)]
            high = [m + e for m, e in zip(row["episodes"], error, strict=True)]
            axis.plot(episodes, row["episodes"], color=color, label=row["agent"], linewidth=1.8)
            axis.fill_between(episodes, low, high, color=color, alpha=0.2, linewidth=0)
        if here[0]["optimum"] is not None:
            axis.axhline(here[0]["optimum"], color="black", linewidth=0.8, label="oracle (knows the goal)")
        axis.set_title("no disturbance" if p == 0 else f"{_disturbed(here)} = {p:g}", fontsize=10)
        axis.set_xlabel("online episode")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        top, lowest = max(row["optimum"] or max(row["episodes"]) for row in rows), min(min(row["episodes"]) for row in rows)
        if lowest >= 0 < top:
            axis.set_ylim(0, 1.08 * top)
        axis.grid(alpha=0.25)
    axes[0][0].set_ylabel("return on goals never trained on" if rows[0]["optimum"] is not None else "return")
    figure.legend(*axes[0][0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(title, fontsize=11)
    return _saved(figure, path)


def _disturbed(rows: Sequence[Mapping[str, Any]]) -> str:
    return "adversary's strength" if rows[0]["optimum"] is None else "steps disturbed with p"


def agreement(report: Mapping[str, Any], path: Path, title: str) -> Path:
    """T_theta compared with the exact posterior: KL by prefix, probabilities and online return.  Returns ``path``.

    ``report``: the numbers of ``heldout.posterior``.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 8), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, (name, (goals, color)) in zip(axes, _GOALS.items(), strict=True):
        row[0].sharey(row[1])
        for axis, (prior, meaning) in zip(row, _PRIORS.items(), strict=False):
            _by_prefix(axis, report[f"{name}{prior}_curves"]["by_prefix"])
            axis.set_title(f"{goals}; {meaning}", fontsize=10)
            axis.set(xlabel="transitions in the context", ylabel="KL(exact || model), nats")
        points = report[f"{name}_any_curves"]["agreement"]
        axes[0][2].plot(points["exact"], points["model"], "o-", color=color, markersize=4, label=goals)
    axes[0][2].plot([0, 1], [0, 1], color="black", linewidth=0.8)
    axes[0][2].set_title("probabilities of actions; any adversary", fontsize=10)
    axes[0][2].set(xlabel="exact probability", ylabel="the model's, on average")
    for shift, (name, (goals, color)) in zip((-0.15, 0.15), zip(_GAPS, _GOALS.values(), strict=True), strict=True):
        at = [100 * row["gap"] for row in report[name].values()]
        error = [
            [0.0 if row[side] is None else 100 * abs(row[side] - row["gap"]) for row in report[name].values()]
            for side in ("low", "high")
        ]
        axes[1][2].bar(
            [i + shift for i in range(len(at))], at, 0.28, yerr=error, color=color, alpha=0.8, capsize=3, label=goals
        )
    axes[1][2].axhline(0, color="black", linewidth=0.8)
    axes[1][2].set_xticks(range(len(report["paper_gap"])), [f"p = {p}" for p in report["paper_gap"]])
    axes[1][2].set_title("online, both by Algorithm 1", fontsize=10)
    axes[1][2].set_ylabel("return over the exact agent's, less 1 (%)")
    for axis in axes.flat:
        axis.grid(alpha=0.25)
    for axis in axes[:, 2]:
        axis.legend(fontsize=8)
    figure.legend(*axes[0][0].get_legend_handles_labels(), fontsize=8, loc="outside lower left", ncols=6, frameon=False)
    figure.suptitle(title, fontsize=11)
    return _saved(figure, path)


def _by_prefix(axis: Any, curves: Sequence[Mapping[str, Any]], width: int = 5) -> None:
    """KL by the length of the prefix, averaged over ``width`` or more lengths; dashed lines where p > 0."""
    kinds = list(dict.fromkeys(curve["kind"] for curve in curves))
    for curve in curves:
        kl = curve["kl"]
        starts = range(0, max(1, len(kl) - width + 1), width)
        pieces = [(a, b, kl[a:b]) for a, b in zip(starts, (*starts[1:], len(kl)), strict=True)]
        label, style = f"{curve['kind']}, p = {curve['p']:g}", "--" if curve["p"] else "-"
        x, y = [(a + b - 1) / 2 for a, b, _ in pieces], [sum(piece) / len(piece) for _, _, piece in pieces]
        axis.plot(x, y, style, color=COLORS[kinds.index(curve["kind"])], label=label)
    axis.set_ylim(bottom=0)


def _is_exact(row: Mapping[str, Any]) -> bool:
    return str(row["key"]).startswith("exact:")


def _saved(figure: Any, path: Path) -> Path:
    atomic_write(path, lambda file: figure.savefig(file, format="png", dpi=130))
    return path
