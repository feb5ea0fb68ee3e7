"""Runs the jobs of a method in this process: shared by the tests of methods, policies and training."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch

from icrl_dist.collect import kinds
from icrl_dist.config.run import Run
from icrl_dist.config.sections import ModelConfig
from icrl_dist.interfaces import Method, Phase, VariationKey
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry as problems
from icrl_dist.types import Job, Spec, Trajectory


class InMemoryDataset:
    """A ``TrajectoryDataset`` in memory; trajectories are added in any order."""

    def __init__(self, trajectories: Iterable[Trajectory] = ()) -> None:
        self.trajectories = list(trajectories)

    def variations(self, stage: str, round: int) -> Sequence[VariationKey]:
        return sorted({t.identity[:4] for t in self.trajectories if t.identity[:2] == (stage, round)})

    def trials(self, key: VariationKey) -> list[Trajectory]:
        return sorted((t for t in self.trajectories if t.identity[:4] == key), key=lambda t: t.identity.trial)


class FixedWeights:
    """One untrained model for every policy version; ``requested`` lists the versions that jobs asked for."""

    def __init__(self, spec: Spec, config: ModelConfig) -> None:
        torch.manual_seed(0)
        self.model = PretrainedTransformer(spec, config).eval()
        self.requested: list[int] = []

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        self.requested.append(version)
        return self.model, f"digest {version}"


class NoWeights:
    """For jobs that need no model."""

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        raise AssertionError(f"a job without a model asked for policy version {version}")


def do(run: Run, job: Job, weights: Any = None, worker: str = "w") -> list[Trajectory]:
    """All trajectories of a job."""
    return list(kinds.do(job, problems.of(run), methods.of(run), weights or NoWeights(), worker))


def collect(run: Run, phase: Phase, weights: Any = None, method: Method | None = None) -> list[Trajectory]:
    """All trajectories of a phase."""
    jobs = (method or methods.of(run)).ask(run, phase)
    return [trajectory for job in jobs for trajectory in do(run, job, weights)]
