"""Trajectories of a run's own jobs, for tests that need some and no model."""

from __future__ import annotations

import dataclasses

from icrl_dist.collect import kinds
from icrl_dist.config.run import Run
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry as problems
from icrl_dist.types import Job, Trajectory


def first_jobs(run: Run, count: int, method: str = "dpt") -> tuple[Job, ...]:
    """The first jobs of a method's first phase."""
    run = dataclasses.replace(run, method=method)
    made = methods.of(run)
    return made.ask(run, made.phases(run)[0])[:count]


def collected(run: Run, count: int, worker: str = "w", method: str = "dpt") -> list[Trajectory]:
    """What these jobs deliver."""
    problem, made = problems.of(run), methods.of(dataclasses.replace(run, method=method))
    return [t for job in first_jobs(run, count, method) for t in kinds.do(job, problem, made, None, worker)]
