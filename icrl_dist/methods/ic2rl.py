"""In-context robust RL (section 3.2): DPT's contexts, labels from the robust policy of each task (eq. 4)."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import ClassVar

from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.interfaces import Phase, UsedLabels
from icrl_dist.methods import jobs
from icrl_dist.methods.dpt import DPT, no_dagger
from icrl_dist.problems import registry
from icrl_dist.types import Job


class IC2RL(DPT):
    """As DPT, with the labels of pi^rb in place of those of pi*."""

    name = "ic2rl"
    section: ClassVar[str] = "robust"
    Config: ClassVar[type] = RobustConfig

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        yield from no_dagger(run)
        try:
            found = registry.of(run).robust_contexts(run)
        except ConfigError as error:
            yield "method", run.method, str(error)
            return
        if found is None:
            yield "method", run.method, f"{run.problem} has no second player, so it has no robust policies: use dpt or icag"

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """DPT's jobs, which label by the robust policies."""
        return jobs.pretraining_contexts(
            run, phase, functools.partial(self._choose, run), registry.of(run).robust_contexts(run)
        )

    def used_labels(self, run: Run, phase: Phase, job: Job) -> UsedLabels | None:
        used = super().used_labels(run, phase, job)
        return used and used._replace(source=f"robust {used.source}")
