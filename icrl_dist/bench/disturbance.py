"""What the default disturbances cost: the return that an undisturbed expert loses under each.

An adversary that takes nothing away makes a variation that is no other task.  In DeepMind Control
the expert is a SAC expert of the problem's nominal task; in Meta-World it is the scripted policy,
told the goal, which sees hand and object where the adversary shows them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from icrl_dist.config.run import ConfigError, load
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.toml import nearest
from icrl_dist.experts import cache
from icrl_dist.experts.cache import History
from icrl_dist.experts.train import ExpertPolicy, train_expert
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.network_adversary import networks
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.rollout.deployment import Actor, deploy_online
from icrl_dist.types import Adversary, Job, Task, Variation

PROBLEMS = (*domains.PROBLEMS, pick_place.KIND)
WEAK = 0.02
"""Share of the return that the default adversaries take on average, below which they are called weak."""
EARNS = 0.01
"""Mean reward a step that an expert must earn undisturbed, or there is nothing to lose."""
LONGER = dict.fromkeys(("dmc-cheetah-run", "dmc-reacher-easy", "dmc-reacher-hard"), 36_000)
"""Steps of an expert's training where it has hardly begun to earn after its run file's 12,000."""
_CHANCE, _ADVERSARIES = 1, 2

Report = Callable[[str], None]
Make = Callable[[Any], Actor]
"""The policy that acts in a batch of environments."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    adversaries: int = 9
    """K, beside the null adversary."""
    episodes: int = 10
    """Under each adversary, in DeepMind Control."""
    tasks: int = 5
    """Of Meta-World, where a task begins always alike: each for one episode under each adversary."""
    steps: int = 0
    """Of an expert's training; 0: its run file's, or those of ``LONGER``."""


QUICK = Sizes(episodes=3, tasks=2, steps=4_000)


@dataclasses.dataclass(frozen=True)
class Setting:
    """Which disturbance of a problem: at strength 1, the largest force of a preset, or so many metres."""

    forces: str
    """``paper`` or ``qarl``; Meta-World: empty."""
    task: Task
    """Of an adversary's widths and strength; DeepMind Control: the nominal one, which the expert was trained in."""
    outputs: int
    """Components of an adversary's action."""


def run(
    problem: str | None = None,
    quick: bool = False,
    report: Report = lambda said: None,
    sizes: Sizes | None = None,
) -> dict[str, Any]:
    """Shares of the return that are lost under K default adversaries, of every problem or of the one named.

    Experts are those of the problem's laptop run file, in its cache: what was trained before is not
    trained again.  Raises ConfigError for an unknown problem.
    """
    if problem is not None and problem not in PROBLEMS:
        known = ", ".join(PROBLEMS)
        raise ConfigError(f"bench disturbance: problem = {problem!r}{nearest(problem, PROBLEMS)}: choose one of {known}")
    sizes = sizes or (QUICK if quick else Sizes())
    rows = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for kind in PROBLEMS if problem is None else (problem,):
            config = numbers(kind, sizes.steps)
            make = policy(kind, config, report)
            for one in settings(kind):
                report(f"{kind}: {sizes.adversaries} adversaries{one.forces and f', forces of {one.forces}'}")
                rows.append(_row(kind, one, make, sizes, config))
                report(describe_row(rows[-1]))
    finally:
        torch.set_num_threads(threads)
    return {"quick": quick, **dataclasses.asdict(sizes), "problems": rows, "weak": sum(bool(row["weak"]) for row in rows)}


def numbers(kind: str, steps: int = 0) -> SACConfig:
    """SAC's numbers for an expert of this problem: its laptop run file's, but for so many ``steps``, or those of ``LONGER``."""
    config = load(f"{kind}-laptop" if kind in domains.PROBLEMS else "metaworld-laptop").sac
    return dataclasses.replace(config, steps=steps or LONGER.get(kind, config.steps))


def settings(kind: str) -> list[Setting]:
    """The disturbances of a problem: both presets of forces where they differ, Meta-World's metres."""
    if kind == pick_place.KIND:
        return [Setting("", pick_place.task((0.0, 0.65, 0.02), (0.0, 0.85, 0.2)), pick_place.MOVED)]
    forces = domains.problem(kind).forces
    presets = ("paper",) if forces["paper"] == forces["qarl"] else ("paper", "qarl")
    return [Setting(one, domains.task(kind, forces=one), forces[one].count) for one in presets]  # type: ignore[index]


def policy(kind: str, config: SACConfig, report: Report) -> Make:
    """Makes the problem's expert; trains it first if it is not in the cache."""
    if kind == pick_place.KIND:
        return ToldTheGoal
    history = expert(kind, config, report)
    return lambda env: ExpertPolicy([history] * env.batch, config)


def expert(kind: str, config: SACConfig, report: Report) -> History:
    """The undisturbed expert of the problem's nominal task, from the cache or of a training."""
    variation = Variation(domains.task(kind))
    found = cache.any_kept(variation, config, 0)
    if found is None:
        report(f"{kind}: an expert trains for {config.steps:,} steps")
        found = next(iter(trained(kind, (variation,), config, report)), None)
    if found is None:
        raise ConfigError(
            f"sac.cache = {config.cache!r}: the expert that was trained is not there; name a folder that keeps it"
        )
    return found


def trained(kind: str, variations: tuple[Variation, ...], config: SACConfig, report: Report) -> list[History]:
    """Undisturbed experts, one a task, from the cache or of a training; those that the cache does not keep are missing."""
    told = itertools.count(1)

    def tell(text: str, note: bool = False, reached: int = 0) -> None:
        if note or next(told) % 10 == 0:
            report(f"{kind}: {text}")

    asked = (*cache.settings(config), ("decoy_fraction", 0.0), ("queries", 1), ("window", 1), ("windows", 0))
    for _ in train_expert(Job("train_expert", "pretrain", 0, 0, variations, 1, -1, 0, asked, len(variations)), "bench", tell):
        pass  # what is wanted is in the cache
    return [history for one in variations if (history := cache.any_kept(one, config, 0)) is not None]


class ToldTheGoal:
    """Meta-World's scripted policy: it acts by what it is shown of hand and object, and the true goal."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.succeeded: Bool[np.ndarray, " B"] = np.zeros(env.batch, bool)
        """Where the object was at the goal once."""

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """What it does if what is shown were true."""
        from icrl_dist.problems.metaworld.environment import expert as scripted

        seen = observation.astype(np.float64)
        seen[:, 36:] = self._env.truth[:, 36:]
        return scripted(seen)

    def observe(self, *transition: object) -> None:
        """Remember who has succeeded."""
        self.succeeded = self.succeeded | self._env.success


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """C episodes under each of R adversaries."""

    returns: Float[np.ndarray, "C R"]
    broken: int
    """Episodes in which a simulation broke down, and earned nothing from then on."""
    succeeded: Float[np.ndarray, " R"] | None
    """Share of the tasks that succeeded, where the game knows success."""


def measure(rows: Sequence[Variation], make: Make, episodes: int, tasks: int) -> Measured:
    """So many episodes in every row, each begun alike under every adversary of a task.

    ``rows`` are the R variations of each task, task by task: C = episodes x tasks.
    """
    env = registry.batch(rows)
    acting, adversaries = make(env), len(rows) // tasks
    chance = ([_chance(number, row // adversaries) for row in range(len(rows))] for number in range(episodes))
    ran = list(deploy_online(env, acting, chance))
    returns = np.stack([one.returns for one in ran]).reshape(episodes * tasks, adversaries)
    broken = sum(int(one.diverged.sum()) for one in ran if one.diverged is not None)
    succeeded = getattr(acting, "succeeded", None)
    shares = None if succeeded is None else succeeded.reshape(tasks, adversaries).mean(axis=0)
    return Measured(returns, broken, shares)


def _chance(episode: int, task: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(0, spawn_key=(_CHANCE, episode, task)))


def variations(one: Setting, sizes: Sizes) -> tuple[list[Variation], int]:
    """The null adversary and K of strength 1 in each task, task by task; and how many tasks."""
    tasks: tuple[Task, ...] = (one.task,)
    if one.task.kind == pick_place.KIND:
        from icrl_dist.problems.metaworld.environment import ml1_tasks

        tasks = ml1_tasks(sizes.tasks)
    return [Variation(task, push) for task in tasks for push in pushes(one, sizes.adversaries)], len(tasks)


def pushes(one: Setting, count: int, strength: float = 1.0) -> tuple[Adversary, ...]:
    """The null adversary and ``count`` others, at every strength the same ones."""
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(_ADVERSARIES,)))
    return networks(rng, count + 1, registry.spec(one.task), one.outputs, strength)


def lost(returns: Float[np.ndarray, "C R"]) -> dict[str, float | None]:
    """What R - 1 adversaries cost, of returns under the null adversary (first) and each of them.

    Shares of the mean undisturbed return: ``lost_mean`` over adversaries, ``lost_worst`` under the
    worst; ``lost_error`` is the first's standard error over episodes, each with its own undisturbed
    one.  Standard errors are None of a single episode, shares where nothing is earned.
    """
    alone, under = returns[:, 0], returns[:, 1:]
    base, apart = float(alone.mean()), _error(alone - under.mean(axis=1))
    return {
        "undisturbed": base,
        "undisturbed_error": _error(alone),
        "mean": float(under.mean()),
        "mean_error": _error(under.mean(axis=1)),
        "worst": float(under.mean(axis=0).min()),
        "lost_mean": 1 - float(under.mean()) / base if base > 0 else None,
        "lost_worst": 1 - float(under.mean(axis=0).min()) / base if base > 0 else None,
        "lost_error": apart / base if apart is not None and base > 0 else None,
    }


def _error(values: Float[np.ndarray, " C"]) -> float | None:
    """Standard error of the mean; None of one value."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def _row(kind: str, one: Setting, make: Make, sizes: Sizes, config: SACConfig) -> dict[str, Any]:
    """One problem under one disturbance, and what is to be said of it."""
    rows, tasks = variations(one, sizes)
    measured = measure(rows, make, 1 if kind == pick_place.KIND else sizes.episodes, tasks)
    found: dict[str, Any] = {name: None if value is None else round(value, 4) for name, value in lost(measured.returns).items()}
    if kind == pick_place.KIND:
        about: dict[str, Any] = {"metres": pick_place.disturbance(one.task)}
    else:
        about = {"forces": one.forces, "newtons": domains.problem(kind).forces[one.forces].largest, "steps": config.steps}  # type: ignore[index]
    if measured.succeeded is not None:
        alone, *under = measured.succeeded.tolist()
        about |= {"success": round(alone, 3), "success_disturbed": round(float(np.mean(under)), 3)}
    return {"problem": kind, **about, "broken": measured.broken, **found, **verdict(found, registry.spec(one.task).horizon)}


def verdict(found: dict[str, float | None], horizon: int) -> dict[str, Any]:
    """``weak``, or ``untaught`` if the expert earns too little for a loss to mean anything, and a sentence of it."""
    base, share = found["undisturbed"], found["lost_mean"]
    if share is None or base is None or base < EARNS * horizon:
        said = f"the expert earns {base or 0.0:.2f} in {horizon} steps, so there is nothing to lose: nothing is known of it"
        return {"weak": False, "untaught": True, "said": said}
    if share < WEAK:
        said = f"weak: on average the default adversaries take {share:.1%} of the return, under {WEAK:.0%}"
        error = found["lost_error"]
        if error is None or share + 2 * error >= WEAK:
            said += "; these episodes are too few to tell it from more"
        return {"weak": True, "untaught": False, "said": said}
    return {"weak": False, "untaught": False, "said": ""}


def describe_row(row: dict[str, Any]) -> str:
    """A problem in one line of the table."""
    of = f"{row['metres'] * 100:g} cm" if "metres" in row else row["forces"]
    error = "" if row["lost_error"] is None else f" +-{row['lost_error']:.1%}"
    shares = ("-", "-") if row["lost_mean"] is None else (f"{row['lost_mean']:.1%}{error}", f"{row['lost_worst']:.1%}")
    cells = f"{row['undisturbed']:>12.1f}{row['mean']:>9.1f}{row['worst']:>9.1f}{shares[0]:>16}{shares[1]:>12}"
    return f"{row['problem']:<22}{of:<7}{cells}  {row['said']}".rstrip()


def describe(result: dict[str, Any]) -> str:
    """The result as a table."""
    head = f"{'problem':<22}{'forces':<7}{'undisturbed':>12}{'mean':>9}{'worst':>9}{'lost, mean':>16}{'lost, worst':>12}"
    of = f"returns of experts that never met a disturbance, under {result['adversaries']} default adversaries"
    return "\n".join([of, head, *map(describe_row, result["problems"])])
