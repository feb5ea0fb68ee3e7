"""Jobs of a run in this process: what its method asks for, and what a worker does with it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from icrl_dist.collect import kinds
from icrl_dist.config.run import Run, make_run
from icrl_dist.interfaces import Progress, VariationKey, Weighted, no_progress
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry
from icrl_dist.stream import wire
from icrl_dist.types import Job, Trajectory


class Fixed:
    """One untrained model for every policy version."""

    def __init__(self, run: Run) -> None:
        self.model = PretrainedTransformer(registry.of(run).spec, run.model).eval()
        self.asked: list[int] = []

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        self.asked.append(version)
        return self.model, f"digest {version}"


class NoWeights:
    """For jobs that need no model."""

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        raise AssertionError(f"a job without a model requested policy version {version}")


class Kept:
    """A dataset in memory, given in any order."""

    def __init__(self, trajectories: Sequence[Trajectory]) -> None:
        self.trajectories = list(trajectories)

    def variations(self, stage: str, round: int) -> list[VariationKey]:
        return sorted({t.identity[:4] for t in self.trajectories if t.identity[:2] == (stage, round)})

    def trials(self, key: VariationKey) -> list[Trajectory]:
        return sorted((t for t in self.trajectories if t.identity[:4] == key), key=lambda t: t.identity.trial)


def asked(run: Run, method: str = "", phase: int = 0) -> tuple[Job, ...]:
    """The jobs of a phase of the run, given its number, by its own method or another one."""
    run = dataclasses.replace(run, method=method or run.method)
    of = methods.of(run)
    return of.ask(run, of.phases(run)[phase])


def decoded(run: Run, data: bytes) -> Job:
    """The job in a message, as a worker of this run decodes it."""
    return wire.decode_job(data, lambda kind, fields: kinds.read_payload(kind, registry.of(run), fields))


def done(
    run: Run, job: Job, weights: Weighted | None = None, worker: str = "w", progress: Progress = no_progress
) -> list[Trajectory]:
    """What the job delivers."""
    return list(kinds.do(job, registry.of(run), methods.of(run), weights or NoWeights(), worker, progress))


def in_problem(run: Run, problem: str, **fields: object) -> Run:
    """The run with another problem and that problem's section, and with these fields."""
    shared = {item.name: getattr(run, item.name) for item in dataclasses.fields(Run)}
    return make_run(**{**shared, "problem": problem, **fields})
