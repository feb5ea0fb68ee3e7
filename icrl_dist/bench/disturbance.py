"""How strong the default disturbances are: the return that an undisturbed expert loses under them.

A disturbance without loss creates variations that are not different tasks.  In DeepMind Control the
expert is a SAC expert of the problem's nominal task.  In Meta-World it is the scripted policy with the
true goal; it observes hand and object as displaced by the adversary.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.toml import nearest
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.disturbance import DisturbanceExperts, Make, Report, Setting
from icrl_dist.problems.continuous.network_adversary import networks
from icrl_dist.rollout.episode import deploy_online
from icrl_dist.types import NULL, Adversary, Task, Variation

WEAK = 0.02
"""Default adversaries are weak if the mean relative loss of return under them is below this."""
MIN_REWARD = 0.01
"""Mean reward per step that an expert needs without disturbance: below it, a relative loss means nothing."""
_EPISODES, _ADVERSARIES = 1, 2  # spawn keys of the generators


@dataclasses.dataclass(frozen=True)
class DisturbanceSizes:
    """The size of the measurement."""

    adversaries: int = 9
    """K, in addition to the null adversary."""
    episodes: int = 10
    """Episodes under each adversary, in DeepMind Control."""
    tasks: int = 5
    """Tasks of Meta-World, each with one episode per adversary, because its initial states are fixed."""
    steps: int = 0
    """Training steps of an expert; 0: the default of the problem."""


QUICK = DisturbanceSizes(episodes=3, tasks=2, steps=4_000)


def run(
    problem: str | None = None,
    quick: bool = False,
    report: Report = lambda text: None,
    sizes: DisturbanceSizes | None = None,
) -> dict[str, Any]:
    """Relative losses of return under K default adversaries, for every problem or for ``problem``.

    Experts have the settings of the problem's laptop run file and are stored in its cache, so each is
    trained only once.  Raises ConfigError for an unknown problem.
    """
    known = problems()
    if problem is not None:
        check(problem, known)
    sizes = sizes or (QUICK if quick else DisturbanceSizes())
    rows = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for kind in known if problem is None else (problem,):
            config = sac_config(kind, sizes.steps)
            make = policy(kind, config, report)
            for setting in settings(kind):
                preset = setting.forces and f", forces of the preset {setting.forces}"
                report(f"{kind}: {sizes.adversaries} adversaries{preset}")
                rows.append(_row(kind, setting, make, sizes, config))
                report(describe_row(rows[-1]))
    finally:
        torch.set_num_threads(threads)
    return {"quick": quick, **dataclasses.asdict(sizes), "problems": rows, "weak": sum(bool(row["weak"]) for row in rows)}


def problems() -> tuple[str, ...]:
    """The names of the problems that have disturbances to measure."""
    parts = {name: registry.problem(name).benchmarks for name in registry.names()}
    return tuple(name for name, part in parts.items() if part is not None and part.experts is not None)


def check(problem: str, known: Sequence[str]) -> None:
    """Raises ConfigError, with the nearest name, for a problem that is not ``known``."""
    if problem not in known:
        raise ConfigError(
            f"bench disturbance: problem = {problem!r}{nearest(problem, known)}: choose one of {', '.join(known)}"
        )


def experts(kind: str) -> DisturbanceExperts:
    """Experts and disturbances of one of ``problems``."""
    part = registry.problem(kind).benchmarks
    assert part is not None and part.experts is not None, kind
    return part.experts


def sac_config(kind: str, steps: int = 0) -> SACConfig:
    """SAC settings for this problem's experts: those of its laptop run file, with ``steps`` or the problem's default."""
    return experts(kind).sac_config(steps)


def settings(kind: str) -> list[Setting]:
    """The disturbances of a problem: both presets of forces if they differ; in Meta-World one displacement."""
    return experts(kind).settings()


def policy(kind: str, config: SACConfig, report: Report) -> Make:
    """The function that makes the problem's expert; trains the expert if it is not in the cache."""
    return experts(kind).policy(config, report)


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredReturns:
    """Returns of C episodes under each of R adversaries."""

    returns: Float[np.ndarray, "C R"]
    broken: int
    """Episodes in which the simulation diverged; rewards after that are 0."""
    succeeded: Float[np.ndarray, " R"] | None
    """Share of the tasks that succeeded; None if the environment does not report success."""


def measure(rows: Sequence[Variation], make: Make, episodes: int, tasks: int) -> MeasuredReturns:
    """Run ``episodes`` in every row.  Episodes of a task have the same initial states under all adversaries.

    ``rows`` are the R variations of each task, task by task: C = episodes x tasks.
    """
    env = registry.batch(rows)
    policy, adversaries = make(env), len(rows) // tasks
    rngs = ([_episode_rng(number, row // adversaries) for row in range(len(rows))] for number in range(episodes))
    ran = list(deploy_online(env, policy, rngs))
    returns = np.stack([episode.returns for episode in ran]).reshape(episodes * tasks, adversaries)
    broken = sum(int(episode.diverged.sum()) for episode in ran if episode.diverged is not None)
    succeeded = getattr(policy, "succeeded", None)
    shares = None if succeeded is None else succeeded.reshape(tasks, adversaries).mean(axis=0)
    return MeasuredReturns(returns, broken, shares)


def _episode_rng(episode: int, task: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(0, spawn_key=(_EPISODES, episode, task)))


def variations(setting: Setting, sizes: DisturbanceSizes) -> tuple[list[Variation], int]:
    """The null adversary and K adversaries of strength 1 in each task, task by task; and the number of tasks."""
    tasks: tuple[Task, ...] = experts(setting.task.kind).tasks(setting, sizes.tasks)
    return [Variation(task, push) for task in tasks for push in adversaries(setting, sizes.adversaries)], len(tasks)


def adversaries(setting: Setting, count: int, strength: float = 1.0) -> tuple[Adversary, ...]:
    """The null adversary and ``count`` networks, which are the same at every strength."""
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(_ADVERSARIES,)))
    return (NULL, *networks(rng, count, registry.spec(setting.task), setting.outputs, strength))


def lost(returns: Float[np.ndarray, "C R"]) -> dict[str, float | None]:
    """The loss under R - 1 adversaries, from returns under the null adversary (first column) and each of them.

    Relative to the mean undisturbed return: ``lost_mean`` is the mean loss over adversaries, ``lost_worst``
    the loss under the worst, ``lost_error`` the standard error of ``lost_mean`` over episodes, each paired
    with its undisturbed episode.  Standard errors are None for a single episode, losses are None if the
    undisturbed return is not positive.
    """
    undisturbed, disturbed = returns[:, 0], returns[:, 1:]
    base, paired_error = float(undisturbed.mean()), _error(undisturbed - disturbed.mean(axis=1))
    return {
        "undisturbed": base,
        "undisturbed_error": _error(undisturbed),
        "mean": float(disturbed.mean()),
        "mean_error": _error(disturbed.mean(axis=1)),
        "worst": float(disturbed.mean(axis=0).min()),
        "lost_mean": 1 - float(disturbed.mean()) / base if base > 0 else None,
        "lost_worst": 1 - float(disturbed.mean(axis=0).min()) / base if base > 0 else None,
        "lost_error": paired_error / base if paired_error is not None and base > 0 else None,
    }


def _error(values: Float[np.ndarray, " C"]) -> float | None:
    """Standard error of the mean; None for a single value."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def _row(kind: str, setting: Setting, make: Make, sizes: DisturbanceSizes, config: SACConfig) -> dict[str, Any]:
    """The result row of one problem under one disturbance."""
    (rows, tasks), part = variations(setting, sizes), experts(kind)
    measured = measure(rows, make, 1 if part.fixed_starts else sizes.episodes, tasks)
    found: dict[str, Any] = {name: None if value is None else round(value, 4) for name, value in lost(measured.returns).items()}
    about = part.describe(setting, config)
    if measured.succeeded is not None:
        undisturbed, *disturbed = measured.succeeded.tolist()
        about |= {"success": round(undisturbed, 3), "success_disturbed": round(float(np.mean(disturbed)), 3)}
    return {"problem": kind, **about, "broken": measured.broken, **found, **verdict(found, registry.spec(setting.task).horizon)}


def verdict(found: dict[str, float | None], horizon: int) -> dict[str, Any]:
    """``weak``, ``low_return`` (too low a return for a relative loss to mean anything) and a sentence, ``note``."""
    base, share = found["undisturbed"], found["lost_mean"]
    if share is None or base is None or base < MIN_REWARD * horizon:
        note = f"the expert's return is {base or 0.0:.2f} in {horizon} steps, too small to measure a loss: train it longer"
        return {"weak": False, "low_return": True, "note": note}
    if share < WEAK:
        note = f"weak: the default adversaries reduce the return by {share:.1%} on average, less than {WEAK:.0%}"
        error = found["lost_error"]
        if error is None or share + 2 * error >= WEAK:
            note += "; with so few episodes the loss may be larger"
        return {"weak": True, "low_return": False, "note": note}
    return {"weak": False, "low_return": False, "note": ""}


def describe_row(row: dict[str, Any]) -> str:
    """A row of the table."""
    disturbance = f"{row['meters'] * 100:g} cm" if "meters" in row else row["forces"]
    error = "" if row["lost_error"] is None else f" +-{row['lost_error']:.1%}"
    shares = ("-", "-") if row["lost_mean"] is None else (f"{row['lost_mean']:.1%}{error}", f"{row['lost_worst']:.1%}")
    cells = f"{row['undisturbed']:>12.1f}{row['mean']:>9.1f}{row['worst']:>9.1f}{shares[0]:>16}{shares[1]:>12}"
    return f"{row['problem']:<22}{disturbance:<7}{cells}  {row['note']}".rstrip()


def describe(result: dict[str, Any]) -> str:
    """The result as a table."""
    head = f"{'problem':<22}{'forces':<7}{'undisturbed':>12}{'mean':>9}{'worst':>9}{'lost, mean':>16}{'lost, worst':>12}"
    title = f"returns of experts trained without disturbance, under {result['adversaries']} default adversaries"
    return "\n".join([title, head, *map(describe_row, result["problems"])])
