"""The SAC experts of a run, from the cache of this node: as files of stable-baselines3, and the list of those of a run."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import icrl_dist
from icrl_dist.config.run import ConfigError, Run, load_folder
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import cache, standing
from icrl_dist.experts.cache import History, expert_seed
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.experts.standing import Standing
from icrl_dist.interfaces import Problem
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry as problems
from icrl_dist.storage.files import write_json
from icrl_dist.stream.schema import as_data
from icrl_dist.types import Job, Spec, Variation

MANIFEST = "manifest.json"
EPISODES = 10
"""Episodes of an expert's evaluation."""


@dataclass(frozen=True)
class Wanted:
    """One expert that a run's jobs train."""

    task: int
    """Number of its task."""
    number: int
    """Its number among the variations of the task."""
    variation: Variation
    seed: int
    """Seed of the run."""
    sac: SACConfig
    horizon: int
    trials: int
    """Episodes of its training that its job delivers."""

    @property
    def name(self) -> str:
        """``task3-variation0``; variation 0 has no adversary, unless ``adversary.null`` is false."""
        return standing.label_of(self.task, self.number)

    @property
    def stored(self) -> bool:
        """Whether the cache of this node has a file of it."""
        return cache.stored(self.variation, self.horizon, self.sac, self.seed)

    def load(self) -> History | None:
        """Its history from the cache of this node; None if it is missing or damaged."""
        return cache.load_any(self.variation, self.horizon, self.sac, self.seed)

    def history(self) -> History:
        """The same, after ``kept`` has found it."""
        found = self.load()
        assert found is not None, f"{self.name} was removed from {self.sac.cache} meanwhile"
        return found


def wanted(run: Run) -> list[list[Wanted]]:
    """The experts of each job of a run; no job if the run needs none."""
    problem, method = problems.of(run), methods.of(run)
    if not isinstance(problem.contexts(run).payload, ExpertHistories):
        return []  # without asking for the jobs of a large run
    asked = method.ask(run, method.phases(run)[0])
    return [list(_of(job, problem, run.sac)) for job in asked if isinstance(job.payload, ExpertHistories)]


def _of(job: Job, problem: Problem, sac: SACConfig) -> Iterator[Wanted]:
    for (task, number), variation in zip(job.rows(), job.variations, strict=True):
        yield Wanted(task, number, variation, job.seed, sac, problem.spec_of(variation.task).horizon, job.trials)


def standings(run: Run, jobs: Sequence[Sequence[Wanted]]) -> list[Standing]:
    """What those experts earn that the cache of this node holds; none if the run asks for no return of them."""
    asks = run.sac.least_return or run.sac.least_return_disturbed
    if not asks or not standing.labels_come_from_experts(problems.of(run)):
        return []
    found = ((one, one.load()) for job in jobs for one in job)
    each = ((one, history) for one, history in found if history is not None)
    return [standing.of([(one.task, one.number)], [one.variation], [history], run.sac)[0] for one, history in each]


def failures(run: Run) -> tuple[str, ...]:
    """A line about the experts of a run in this node's cache that return less than it asks for, if there are any."""
    text = standing.listed(standings(run, wanted(run)))
    return (f"{text}; a method that trains refuses them: {standing.REMEDY}",) if text else ()


def kept(run: Run, what: str) -> list[list[Wanted]]:
    """The experts of each job of a run, all of them in the cache; ``what``: the run folder, for messages.

    Raises ConfigError, with the command that trains them, if the run needs no SAC experts or if some were not kept.
    """
    jobs = wanted(run)
    if not jobs:
        raise ConfigError(f"{what}: this run of {run.problem} trains no SAC experts; name a run that does, as {_EXAMPLE}")
    train = f"`icrl-dist train experts-{what}/run.toml"
    if not run.sac.cache:
        remedy = (
            f"{train} --sac.cache ~/.cache/icrl-dist/experts --out OTHER` trains them again and keeps them; name OTHER then"
        )
        raise ConfigError(f"{what}: its experts were not kept (sac.cache = ''): {remedy}")
    everyone = [one for job in jobs for one in job]
    if missing := sum(one.load() is None for one in everyone):
        where = f"{missing} of its {len(everyone)} experts are not in {run.sac.cache} on this node"
        raise ConfigError(f"{what}: {where}: {train} --out OTHER` trains the missing ones")
    return jobs


_EXAMPLE = "`icrl-dist train experts-dmc-reacher-easy-laptop`"


def export(folder: Path, out: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> list[dict[str, Any]]:
    """Write every expert of the run in ``folder`` to the folder ``out``, as a file that ``stable_baselines3.SAC.load`` opens.

    ``out``/manifest.json, written last, names file, task, adversary and the returns of ``EPISODES`` episodes of the mean
    action in that variation.  The critics in the files are untrained: the cache keeps actors only.  ``progress(done, total)``
    counts experts.  Returns the experts' entries of the manifest.

    Raises ConfigError if experts were not kept or do not fit the settings, or if ``out`` holds other files; OSError if it
    cannot be written.
    """
    import torch

    from icrl_dist.experts.checkpoints import evaluate
    from icrl_dist.experts.sac import draws
    from icrl_dist.experts.sac.batched import SACBatch
    from icrl_dist.experts.train import ExpertPolicy

    run = load_folder(folder)
    jobs, problem, entries = kept(run, str(folder)), problems.of(run), list[dict[str, Any]]()
    for one in (one for job in jobs for one in job):
        _require_shape(one, problem.spec_of(one.variation.task))
    _require_free(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / MANIFEST).unlink(missing_ok=True)
    for job in jobs:
        env = problem.batch([one.variation for one in job])
        policy = ExpertPolicy([one.history() for one in job], job[0].sac)
        unused, seeds = np.zeros((len(job), env.spec.actions)), [expert_seed(one.variation, one.seed) for one in job]
        act = lambda observation, policy=policy, unused=unused: policy.act(observation, unused)  # noqa: E731
        returns = evaluate(env, act, seeds, draws.EVALUATION, EPISODES)
        for row, (one, seed) in enumerate(zip(job, seeds, strict=True)):
            expert = SACBatch([seed], env.spec, one.sac, "cpu", capacity=1)
            expert.arrays["actor"].copy_(torch.from_numpy(one.history().actor))
            expert.save_sb3(0, out / f"{one.name}.zip")
            entries.append(_entry(one, env.spec, returns[:, row]))
            progress(len(entries), sum(map(len, jobs)))
    about = {"icrl_dist": icrl_dist.__version__, "run": folder.resolve().name, "problem": run.problem, "seed": run.seed}
    write_json(out / MANIFEST, {**about, "sac": as_data(jobs[0][0].sac), "episodes": EPISODES, "experts": entries})
    return entries


def _require_free(out: Path) -> None:
    """Raises ConfigError unless ``out`` is a new or empty folder, or one of an earlier export."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: is a file; name a folder for the experts")
    if out.is_dir() and any(out.iterdir()):
        try:
            known = {MANIFEST, *(str(one["file"]) for one in json.loads((out / MANIFEST).read_text())["experts"])}
        except (OSError, ValueError, KeyError, TypeError):
            known = set()
        if others := sorted(path.name for path in out.iterdir() if path.name not in known):
            raise ConfigError(f"--out {out}: holds other files, such as {others[0]}; name a new folder")


def _require_shape(one: Wanted, spec: Spec) -> None:
    from icrl_dist.experts.sac.stacked import Shape

    history, needed = one.history(), Shape((spec.observation, *one.sac.hidden, 2 * spec.actions)).parameters
    found = len(history.actor), history.observations.shape[-1], history.actions.shape[-1]
    if found != (needed, spec.observation, spec.actions):
        raise ConfigError(
            f"{one.name} in {one.sac.cache}: an actor of {found[0]} parameters for {found[1]} observations and {found[2]} "
            f"actions, not {needed}, {spec.observation} and {spec.actions} (sac.hidden = {list(one.sac.hidden)}): remove that "
            "cache, and train the experts again"
        )


def _entry(one: Wanted, spec: Spec, returns: np.ndarray) -> dict[str, Any]:
    task, adversary = one.variation.task, one.variation.adversary
    return {
        "file": f"{one.name}.zip",
        "task": {"kind": task.kind, **dict(task.params)},
        "adversary": {"kind": adversary.kind, **dict(adversary.params)},
        "horizon": spec.horizon,
        "observations": spec.observation,
        "actions": spec.actions,
        "return": round(float(returns.mean()), 4),
        "returns": [round(float(value), 4) for value in returns],
    }
