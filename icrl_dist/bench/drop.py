"""Calibrates ``drop:SHARE``: finds and stores the strength at which undisturbed experts lose this share of their return.

In DeepMind Control the tasks are those of the smallest training set, the central 2x2 of the grid, each with
its own undisturbed SAC expert; in Meta-World they are the first training tasks, with the scripted policy
of ``problems/metaworld/bench.py``.  All strengths are compared on the same episodes (same initial states) and networks.
"""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Callable
from importlib import metadata
from typing import Any

import torch

from icrl_dist.bench import disturbance
from icrl_dist.bench.disturbance import DisturbanceSizes, experts, lost, measure, settings
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sac import SACConfig
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.problems.continuous.disturbance import Make, Report, Setting
from icrl_dist.storage.files import write_json
from icrl_dist.types import Task, Variation

COMPETENT = 0.25
"""Mean reward per step, as a share of the largest reward, that experts need without disturbance; the drop of a worse
expert means nothing."""
FIRST, MOST = 2.0**-3, 2.0**14
"""The smallest and the largest strength tried; strengths are doubled, then bisected to 2%."""
SIZES = DisturbanceSizes(episodes=3)

Loss = Callable[[float], float]
"""The relative loss of return at a strength, with the same random draws at every call."""


@dataclasses.dataclass(frozen=True)
class Solved:
    """The smallest strength found whose loss is at least the given share."""

    strength: float
    lost: float
    """The loss at this strength."""
    reached: bool
    """False if the loss is smaller even at ``strength``, the largest strength tried."""
    tried: tuple[tuple[float, float], ...]
    """Every strength tried and its loss, smallest strength first."""


def solve(loss: Loss, drop: float, first: float = FIRST, most: float = MOST, tolerance: float = 0.02) -> Solved:
    """The smallest strength at which ``loss`` is at least ``drop``, exceeded by at most the relative ``tolerance``.

    The loss need not be monotone: strengths are doubled until the first with a loss of at least ``drop``;
    bisection then keeps an upper end with such a loss.  A loss that rises and falls again between two
    tried strengths is missed.
    """
    tried: dict[float, float] = {}

    def reaches(strength: float) -> bool:
        tried[strength] = loss(strength)
        return tried[strength] >= drop

    low, high = 0.0, first
    while not reaches(high):
        if high >= most:
            return Solved(high, tried[high], False, tuple(sorted(tried.items())))
        low, high = high, min(2 * high, most)
    while high - low > tolerance * high:
        middle = (low + high) / 2
        low, high = (low, middle) if reaches(middle) else (middle, high)
    return Solved(high, tried[high], True, tuple(sorted(tried.items())))


def run(
    drop: float,
    problem: str | None = None,
    steps: int | None = None,
    report: Report = lambda text: None,
    sizes: DisturbanceSizes | None = None,
) -> dict[str, Any]:
    """Calibrate ``drop`` for a problem, or for all whose experts are known to be competent, and store it in the user's table.

    ``steps`` of SAC for the experts; default: those of ``bench disturbance``.  Raises ConfigError for an
    unknown problem and for experts that are not competent.
    """
    calibrated_strength.share(f"drop:{drop:g}")
    known = disturbance.problems()
    if problem is not None:
        disturbance.check(problem, known)
    chosen = [name for name in known if experts(name).competent] if problem is None else [problem]
    file = calibrated_strength.own_file()
    threads, rows = torch.get_num_threads(), []
    torch.set_num_threads(1)
    try:
        for kind in chosen:
            rows += _calibrate(kind, drop, steps, report, sizes or SIZES)
    finally:
        torch.set_num_threads(threads)
    return {
        "drop": drop,
        "problems": rows,
        "file": str(file),
        "ok": all(row["reached"] for row in rows),
    }


def _calibrate(kind: str, drop: float, steps: int | None, report: Report, sizes: DisturbanceSizes) -> list[dict[str, Any]]:
    """The rows of one problem, one per disturbance."""
    config = disturbance.sac_config(kind)
    config = config if steps is None else dataclasses.replace(config, steps=steps)
    make = _expert(kind, config, report)
    rows: list[dict[str, Any]] = []
    for setting in settings(kind):
        row = _row(kind, setting, make, drop, config, report, sizes)
        row["command"] = f"icrl-dist bench disturbance --problem {kind} --drop {drop:g}" + (
            f" --steps {steps}" if steps else ""
        )
        if row["reached"]:
            _store(row)
        rows.append(row)
        report(describe_row(row))
    return rows


def _row(
    kind: str, setting: Setting, make: Make, drop: float, config: SACConfig, report: Report, sizes: DisturbanceSizes
) -> dict[str, Any]:
    part, tasks = experts(kind), _tasks(kind, setting, sizes)
    found: dict[float, dict[str, float | None]] = {}
    episodes = 1 if part.fixed_starts else sizes.episodes

    def loss(strength: float) -> float:
        adversaries = disturbance.adversaries(setting, sizes.adversaries, strength)
        rows = [Variation(task, adversary) for task in tasks for adversary in adversaries]
        measured = measure(rows, make, episodes, len(tasks))
        found[strength] = losses = {**lost(measured.returns), "broken": measured.broken}
        earned, share = losses["undisturbed"], losses["lost_mean"]
        if share is None or earned is None or earned < _competent_return(kind, setting):
            needed = f"have a return of {earned:.1f} undisturbed, below {_competent_return(kind, setting):g}"
            raise ConfigError(f"bench disturbance --drop {drop:g}: the experts of {kind} {needed}: {part.remedy}")
        report(f"{kind} {setting.forces}: at strength {strength:g} the return drops by {share:.1%}")
        return share

    answer = solve(loss, drop)
    names = ("undisturbed", "undisturbed_error", "lost_mean", "lost_worst", "lost_error", "broken")
    return {
        "problem": kind,
        **part.calibration_key(setting),
        "drop": drop,
        "strength": answer.strength,
        "reached": answer.reached,
        **{name: found[answer.strength][name] for name in names},
        "expert": part.expert(config),
        "tasks": len(tasks),
        "adversaries": sizes.adversaries,
        "episodes": episodes,
        "tried": [[strength, round(share, 4)] for strength, share in answer.tried],
        "versions": {name: metadata.version(name) for name in ("dm-control", "metaworld", "mujoco", "torch")},
        "date": datetime.date.today().isoformat(),
    }


def _competent_return(kind: str, setting: Setting) -> float:
    return COMPETENT * registry.spec(setting.task).horizon * experts(kind).most_reward


def _tasks(kind: str, setting: Setting, sizes: DisturbanceSizes) -> tuple[Task, ...]:
    return experts(kind).calibration_tasks(setting, sizes.tasks)


def _expert(kind: str, config: SACConfig, report: Report) -> Make:
    """The function that makes the tasks' experts, each for the rows of its task; trains those that are not in the cache."""
    return experts(kind).calibration_policy(config, report)


def _store(row: dict[str, Any]) -> None:
    """Store the row in the user's table; it replaces an earlier row for the same disturbance and drop."""
    key = ("problem", "forces", "meters", "drop")
    others = [old for old in calibrated_strength.own() if any(old[name] != row[name] for name in key)]
    write_json(calibrated_strength.own_file(), [*others, row])


def describe_row(row: dict[str, Any]) -> str:
    """A row of the table."""
    disturbance = f"{row['meters'] * 100:g} cm" if row["meters"] else "/".join(row["forces"])
    error = "" if row["lost_error"] is None else f" +-{row['lost_error']:.1%}"
    note = "" if row["reached"] else f"  less than {row['drop']:.0%} even at the largest strength tried: not stored"
    return (
        f"{row['problem']:<22}{disturbance:<12}{row['strength']:>10.4g}{row['lost_mean']:>9.1%}{error:<9}{row['lost_worst']:>8.1%}"
        f"{row['undisturbed']:>12.1f}  {row['expert']}{note}"
    )


def describe(result: dict[str, Any]) -> str:
    """The result as a table."""
    head = f"{'problem':<22}{'forces':<12}{'strength':>10}{'lost':>9}{'':<9}{'worst':>8}{'undisturbed':>12}  expert"
    title = (
        f"smallest strength at which undisturbed experts lose {result['drop']:.0%} of their return; stored in {result['file']}"
    )
    return "\n".join([title, head, *map(describe_row, result["problems"])])
