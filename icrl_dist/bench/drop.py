"""The strength at which undisturbed experts lose a given share of their return, solved and kept (``drop:0.25``).

In DeepMind Control the tasks are those of the smallest training set, the central 2x2 of the grid, each with
an undisturbed SAC expert of its own; in Meta-World the first training tasks with the scripted policy of
``bench.disturbance``.  Losses at all strengths are of the same episodes, begun alike, under the same K networks.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Callable
from importlib import metadata
from typing import Any

import torch

from icrl_dist.bench import disturbance
from icrl_dist.bench.disturbance import Make, Report, Setting, Sizes, lost, measure, settings
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.toml import nearest
from icrl_dist.experts.train import ExpertPolicy
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.storage.files import atomic_write
from icrl_dist.types import Task, Variation

KNOWN = ("dmc-cartpole-balance", pick_place.KIND)
"""Problems whose experts are known to be competent with their laptop numbers."""
COMPETENT = 0.25
"""Mean reward a step, of at most 1, that experts must earn undisturbed: a drop of a worse one says nothing."""
FIRST, MOST = 2.0**-3, 2.0**14
"""The strengths between which the drop is searched, each twice the one before; then within 2% by bisection."""
SIZES = Sizes(episodes=3)

Loss = Callable[[float], float]
"""Share of the return that is lost at a strength; the same chance at every call."""


@dataclasses.dataclass(frozen=True)
class Solved:
    """The smallest strength found that takes the share asked for."""

    strength: float
    lost: float
    """At this strength."""
    reached: bool
    """False: not even ``strength``, the largest that was tried, takes as much."""
    tried: tuple[tuple[float, float], ...]
    """Every strength and what it took, smallest first."""


def solve(loss: Loss, drop: float, first: float = FIRST, most: float = MOST, tolerance: float = 0.02) -> Solved:
    """The smallest strength at which ``loss`` is at least ``drop``, to ``tolerance`` of itself from above.

    The loss need not be monotone: strengths are tried upwards, each twice the one before, and the first
    that takes ``drop`` ends the ladder; bisection then keeps an upper end that does.  What rises and
    falls again between two rungs is not seen.
    """
    tried: dict[float, float] = {}

    def ask(strength: float) -> bool:
        tried[strength] = loss(strength)
        return tried[strength] >= drop

    low, high = 0.0, first
    while not ask(high):
        if high >= most:
            return Solved(high, tried[high], False, tuple(sorted(tried.items())))
        low, high = high, min(2 * high, most)
    while high - low > tolerance * high:
        middle = (low + high) / 2
        low, high = (low, middle) if ask(middle) else (middle, high)
    return Solved(high, tried[high], True, tuple(sorted(tried.items())))


def run(
    drop: float,
    problem: str | None = None,
    steps: int | None = None,
    report: Report = lambda said: None,
    sizes: Sizes | None = None,
) -> dict[str, Any]:
    """Solve ``drop`` for a problem, or for those with experts known to be competent, and keep it in the user's own table.

    ``steps`` of SAC for a problem's experts, instead of those of ``bench disturbance``.  Raises ConfigError
    for an unknown problem, and for experts that are not competent.
    """
    calibrated_strength.share(f"drop:{drop:g}")
    known = (*domains.PROBLEMS, pick_place.KIND)
    if problem is not None and problem not in known:
        raise ConfigError(
            f"bench disturbance: problem = {problem!r}{nearest(problem, known)}: choose one of {', '.join(known)}"
        )
    threads, rows = torch.get_num_threads(), []
    torch.set_num_threads(1)
    try:
        for kind in KNOWN if problem is None else (problem,):
            rows += _solved(kind, drop, steps, report, sizes or SIZES)
    finally:
        torch.set_num_threads(threads)
    return {
        "drop": drop,
        "problems": rows,
        "file": str(calibrated_strength.own_file()),
        "ok": all(row["reached"] for row in rows),
    }


def _solved(kind: str, drop: float, steps: int | None, report: Report, sizes: Sizes) -> list[dict[str, Any]]:
    """One problem under each of its disturbances."""
    config = disturbance.numbers(kind)
    config = config if steps is None else dataclasses.replace(config, steps=steps)
    make = _expert(kind, config, report)
    rows: list[dict[str, Any]] = []
    for one in settings(kind):
        row = _row(kind, one, make, drop, config, report, sizes)
        row["command"] = f"icrl-dist bench disturbance --problem {kind} --drop {drop:g}" + (
            f" --steps {steps}" if steps else ""
        )
        if row["reached"]:
            _keep(row)
        rows.append(row)
        report(describe_row(row))
    return rows


def _row(kind: str, one: Setting, make: Make, drop: float, config: SACConfig, report: Report, sizes: Sizes) -> dict[str, Any]:
    chosen = _tasks(kind, one, sizes)
    found: dict[float, dict[str, float | None]] = {}
    episodes = 1 if kind == pick_place.KIND else sizes.episodes

    def loss(strength: float) -> float:
        pushed = disturbance.pushes(one, sizes.adversaries, strength)
        rows = [Variation(task, push) for task in chosen for push in pushed]
        measured = measure(rows, make, episodes, len(chosen))
        found[strength] = cost = {**lost(measured.returns), "broken": measured.broken}
        earned, share = cost["undisturbed"], cost["lost_mean"]
        if share is None or earned is None or earned < _needed(kind, one):
            remedy = "its scripted policy has failed" if kind == pick_place.KIND else "train longer with --steps"
            needed = f"earn {earned:.1f} undisturbed, not {_needed(kind, one):g}"
            raise ConfigError(f"bench disturbance --drop {drop:g}: the experts of {kind} {needed}: {remedy}")
        report(f"{kind} {one.forces}: strength {strength:g} takes {share:.1%}")
        return share

    answer = solve(loss, drop)
    preset = ["paper", "qarl"] if len(settings(kind)) == 1 else [one.forces]
    scripted = kind == pick_place.KIND
    names = ("undisturbed", "undisturbed_error", "lost_mean", "lost_worst", "lost_error", "broken")
    return {
        "problem": kind,
        "forces": [] if scripted else preset,
        "metres": pick_place.DISTURBANCE if scripted else 0.0,
        "drop": drop,
        "strength": answer.strength,
        "reached": answer.reached,
        **{name: found[answer.strength][name] for name in names},
        "expert": "scripted" if scripted else f"SAC, {config.steps:,} steps, {'-'.join(map(str, config.hidden))}",
        "tasks": len(chosen),
        "adversaries": sizes.adversaries,
        "episodes": episodes,
        "tried": [[strength, round(share, 4)] for strength, share in answer.tried],
        "versions": {name: metadata.version(name) for name in ("dm-control", "metaworld", "mujoco", "torch")},
        "date": datetime.date.today().isoformat(),
    }


def _needed(kind: str, one: Setting) -> float:
    return COMPETENT * registry.spec(one.task).horizon * (10 if kind == pick_place.KIND else 1)


def _tasks(kind: str, one: Setting, sizes: Sizes) -> tuple[Task, ...]:
    if kind != pick_place.KIND:
        return tuple(task.replace(forces=one.forces) for task in domains.grid(kind, 2))
    from icrl_dist.problems.metaworld.environment import ml1_tasks

    return ml1_tasks(sizes.tasks)


def _expert(kind: str, config: SACConfig, report: Report) -> Make:
    """Makes the tasks' experts, each in the rows of its own task; trains them first if they are not in the cache."""
    if kind == pick_place.KIND:
        return disturbance.ToldTheGoal
    variations = tuple(Variation(task) for task in domains.grid(kind, 2))
    found = disturbance.trained(kind, variations, config, report)
    if len(found) < len(variations):
        raise ConfigError(f"sac.cache = {config.cache!r}: the experts that were trained are not there; name a folder")
    return lambda env: ExpertPolicy([one for one in found for _ in range(env.batch // len(found))], config)


def _keep(row: dict[str, Any]) -> None:
    """In the user's own table, in the place of what it held for the same."""
    key = ("problem", "forces", "metres", "drop")
    others = [old for old in calibrated_strength.own() if any(old[name] != row[name] for name in key)]
    file = calibrated_strength.own_file()
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(file, lambda out: out.write(json.dumps([*others, row], indent=1).encode() + b"\n"))


def describe_row(row: dict[str, Any]) -> str:
    """A problem in one line of the table."""
    of = f"{row['metres'] * 100:g} cm" if row["metres"] else "/".join(row["forces"])
    error = "" if row["lost_error"] is None else f" +-{row['lost_error']:.1%}"
    said = "" if row["reached"] else f"  not {row['drop']:.0%}, even at the largest strength tried: not kept"
    return (
        f"{row['problem']:<22}{of:<12}{row['strength']:>10.4g}{row['lost_mean']:>9.1%}{error:<9}{row['lost_worst']:>8.1%}"
        f"{row['undisturbed']:>12.1f}  {row['expert']}{said}"
    )


def describe(result: dict[str, Any]) -> str:
    """The result as a table."""
    head = f"{'problem':<22}{'forces':<12}{'strength':>10}{'lost':>9}{'':<9}{'worst':>8}{'undisturbed':>12}  expert"
    of = f"smallest strength at which undisturbed experts lose {result['drop']:.0%} of their return; kept in {result['file']}"
    return "\n".join([of, head, *map(describe_row, result["problems"])])
