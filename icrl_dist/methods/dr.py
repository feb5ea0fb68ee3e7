"""Domain randomisation: ICAG's variations and contexts, but labels that ignore the disturbance."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Phase, UsedLabels
from icrl_dist.methods.icag import ICAG
from icrl_dist.problems import registry
from icrl_dist.types import Job


class DR(ICAG):
    """As ICAG, with the labels of pi*_{tau,phi_0} in every variation (tau, phi)."""

    name = "dr"

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        if not hasattr(registry.of(run).labelling(run), "undisturbed"):
            remedy = f"{run.problem} cannot label disturbed variations by the undisturbed optimum: use icag or dpt"
            yield "method", run.method, remedy

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """ICAG's jobs, whose labeller solves each task under the null adversary."""
        return tuple(map(_undisturbed, super().ask(run, phase)))

    def used_labels(self, run: Run, phase: Phase, job: Job) -> UsedLabels | None:
        used = super().used_labels(run, phase, job)
        return used and used._replace(source=f"undisturbed {used.source}")


def _undisturbed(job: Job) -> Job:
    payload: Any = job.payload  # of a kind with a labelling, because the method collects no other
    labelling = dataclasses.replace(payload.labelling, undisturbed=True)
    return dataclasses.replace(job, payload=dataclasses.replace(payload, labelling=labelling))
