"""What training could reach at most: exact agents without a network, by disturbance and strength.

The exact agent with DPT's prior supposes no disturbance: a perfect DPT.  The one with ICAG's has the prior of training: a
perfect ICAG.  The oracle is given goal and adversary, so no agent exceeds its expected return.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from icrl_dist.config.run import Run, load, override
from icrl_dist.problems import registry
from icrl_dist.results import evaluate
from icrl_dist.results.evaluate import Agent

DISTURBANCES = ("override", "wind", "permuted")
STRENGTHS = (0.2, 0.4, 0.6, 0.8, 1.0)
AGENTS = ("random", "exact:dpt", "exact:dpt-committed", "exact:icag", "exact:icag-committed", "exact:paper", "oracle")
ROOMS = ((7, 35), (10, 100))
"""Size and horizon of the rooms of darkroom-7x7 and of the paper."""
LAST = 5
"""Number of last episodes that a mean is over."""


def run(quick: bool = False, report: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Mean returns in the room of darkroom-7x7 over its last ``LAST`` of 20 episodes, and shares of the optimum.

    Four splits of the goals, each with its own test adversaries and 10 held-out goals, two evaluations of each; ``quick``:
    one split.  ``p_max`` is 1.
    """
    splits, seeds = 1 if quick else 4, 2
    rows = []
    for disturbance in DISTURBANCES:
        report(f"{disturbance}: exact agents")
        runs = [_run(disturbance, 100 + split, seeds) for split in range(splits)]
        rows += _returns(disturbance, runs)
    part = registry.problem("darkroom").benchmarks
    assert part is not None and part.kept is not None
    shares = [
        {"disturbance": one, "size": size, "horizon": horizon, "p": p, "kept": part.kept(one, size, horizon, p)}
        for one in DISTURBANCES
        for size, horizon in ROOMS
        for p in STRENGTHS
    ]
    return {"quick": quick, "splits": splits, "seeds": seeds, "last": LAST, "returns": rows, "kept": shares}


def _run(disturbance: str, split: int, seeds: int) -> Run:
    settings = [f"darkroom.disturbance={disturbance}", f"darkroom.split_seed={split}", f"seed={split}", "adversary.p_max=1.0"]
    settings += [f"evaluate.p={[0.0, *STRENGTHS]}", f"evaluate.seeds={seeds}", "evaluate.episodes=20"]
    return override(load("darkroom-7x7"), settings, "bench ceilings")


def _returns(disturbance: str, runs: list[Run]) -> list[dict[str, Any]]:
    """One row per agent and p: the mean over goals, and its standard error over goals with their adversaries."""
    found: dict[tuple[str, float], list[np.ndarray]] = {}
    for one in runs:
        references = registry.of(one).references(one)
        for result in evaluate.online(one, {Agent(key): references[key] for key in AGENTS}):
            means = result.returns[:, :, -LAST:].mean(axis=(1, 2))
            found.setdefault((result.agent.key, result.p), []).append(means)
    rows = []
    for (key, p), several in found.items():
        goals = np.concatenate(several)
        error = float(goals.std(ddof=1) / np.sqrt(len(goals)))
        rows.append({"disturbance": disturbance, "agent": key, "p": p, "return": float(goals.mean()), "error": error})
    return rows


def describe(result: dict[str, Any]) -> str:
    """The result as text: a table of returns for each disturbance, then the shares of the optimum."""
    lines = []
    for disturbance in DISTURBANCES:
        mine = [row for row in result["returns"] if row["disturbance"] == disturbance]
        levels = sorted({row["p"] for row in mine})
        lines.append(f"{disturbance:<22}" + "".join(f"{f'p = {p:g}':>14}" for p in levels))
        for key in AGENTS:
            cells = {row["p"]: f"{row['return']:.2f} +-{row['error']:.2f}" for row in mine if row["agent"] == key}
            lines.append(f"  {key:<20}" + "".join(f"{cells[p]:>14}" for p in levels))
    lines.append("share of the optimum that the optimal policy of the undisturbed room keeps, given the goal:")
    for disturbance in DISTURBANCES:
        for size, horizon in ROOMS:
            kept = [row for row in result["kept"] if (row["disturbance"], row["size"]) == (disturbance, size)]
            shares = ", ".join(f"{100 * row['kept']:.0f}% at p = {row['p']:g}" for row in kept)
            lines.append(f"  {disturbance}, {size}x{size}, {horizon} steps: {shares}")
    goals = 10 * result["splits"]
    counts = f"{goals} goals, {result['seeds']} evaluations of each"
    lines.append(f"returns: 7x7, last {LAST} of 20 episodes, {counts}; +- standard error over goals and their adversaries")
    return "\n".join(lines)
