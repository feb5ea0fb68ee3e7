"""Figures, drawn from result rows only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

COLOURS = ("#1f6feb", "#8957e5", "#8b949e", "#d29922", "#2da44e")


def adaptation(rows: Sequence[Mapping[str, Any]], path: Path, title: str) -> Path:
    """Return per online episode, one panel for each p (Figures 3b and 3d); the oracle dashed.

    ``rows`` are those of ``evaluate.Result.row``.  Returns ``path``.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import MaxNLocator

    levels = sorted({row["p"] for row in rows})
    figure, axes = pyplot.subplots(1, len(levels), figsize=(4.6 * len(levels), 3.6), sharey=True, squeeze=False)
    for axis, p in zip(axes[0], levels, strict=True):
        here = [row for row in rows if row["p"] == p]
        for colour, row in zip(COLOURS, [r for r in here if r["agent"] != "oracle"], strict=False):
            episodes = range(1, len(row["episodes"]) + 1)
            error = [e or 0.0 for e in row["standard_error"]]
            low = [m - e for m, e in zip(row["episodes"], error, strict=True)]
            high = [m + e for m, e in zip(row["episodes"], error, strict=True)]
            axis.plot(episodes, row["episodes"], color=colour, label=row["agent"], linewidth=1.8)
            axis.fill_between(episodes, low, high, color=colour, alpha=0.2, linewidth=0)
        axis.axhline(here[0]["optimum"], color="black", linestyle="--", linewidth=1, label="oracle (knows the goal)")
        axis.set_title("no disturbance" if p == 0 else f"actions overridden with p = {p:g}", fontsize=10)
        axis.set_xlabel("online episode")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.set_ylim(0, 1.08 * max(row["optimum"] for row in rows))
        axis.grid(alpha=0.25)
    axes[0][0].set_ylabel("return on goals never trained on")
    axes[0][-1].legend(fontsize=8, loc="center right")
    figure.suptitle(title, fontsize=11)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
    return path
