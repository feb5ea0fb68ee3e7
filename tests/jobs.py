"""Jobs of a run in this process: what its method asks for, and what a worker does with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import torch

from icrl_dist.collect import kinds
from icrl_dist.config.run import Run, make_run
from icrl_dist.interfaces import Method, Phase, Progress, VariationKey, WeightSource, no_progress
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry as problems
from icrl_dist.stream import wire
from icrl_dist.types import Job, Trajectory


class InMemoryDataset:
    """A ``TrajectoryDataset`` in memory; trajectories are added in any order."""

    def __init__(self, trajectories: Iterable[Trajectory] = ()) -> None:
        self.trajectories = list(trajectories)

    def variations(self, stage: str, round: int) -> Sequence[VariationKey]:
        return sorted({t.identity[:4] for t in self.trajectories if t.identity[:2] == (stage, round)})

    def trials(self, key: VariationKey) -> list[Trajectory]:
        return sorted((t for t in self.trajectories if t.identity[:4] == key), key=lambda t: t.identity.trial)


class FixedWeights:
    """One untrained model for every policy version; ``requested`` lists the versions that jobs requested."""

    def __init__(self, run: Run) -> None:
        torch.manual_seed(0)
        self.model = PretrainedTransformer(problems.of(run).spec, run.model).eval()
        self.requested: list[int] = []

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        self.requested.append(version)
        return self.model, f"digest {version}"


class NoWeights:
    """For jobs that need no model."""

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        raise AssertionError(f"a job without a model requested policy version {version}")


def jobs_of(run: Run, method: str = "", phase: int = 0) -> tuple[Job, ...]:
    """The jobs of a phase of the run, given its number, by its own method or another one."""
    run = dataclasses.replace(run, method=method or run.method)
    of = methods.of(run)
    return of.ask(run, of.phases(run)[phase])


def decoded(run: Run, data: bytes) -> Job:
    """The job in a message, as a worker of this run decodes it."""
    return wire.decode_job(data, lambda kind, fields: kinds.read_payload(kind, problems.of(run), fields))


def do(
    run: Run, job: Job, weights: WeightSource | None = None, worker: str = "w", progress: Progress = no_progress
) -> list[Trajectory]:
    """All trajectories of a job."""
    return list(kinds.do(job, problems.of(run), methods.of(run), weights or NoWeights(), worker, progress))


def collect(run: Run, phase: Phase, weights: WeightSource | None = None, method: Method | None = None) -> list[Trajectory]:
    """All trajectories of a phase."""
    jobs = (method or methods.of(run)).ask(run, phase)
    return [trajectory for job in jobs for trajectory in do(run, job, weights)]


def collected(run: Run, jobs: int, worker: str = "w", method: str = "dpt") -> list[Trajectory]:
    """What the first jobs of a method's first phase deliver."""
    return [trajectory for job in jobs_of(run, method)[:jobs] for trajectory in do(run, job, None, worker)]


def in_problem(run: Run, problem: str, **fields: object) -> Run:
    """The run with another problem and that problem's section, and with these fields."""
    shared = {item.name: getattr(run, item.name) for item in dataclasses.fields(Run)}
    return make_run(**{**shared, "problem": problem, **fields})
