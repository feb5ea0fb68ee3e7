"""``method = "experts"``: trains the SAC experts of ICAG's variations, and no model; later runs find them in the cache."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from icrl_dist.config.run import Run
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.interfaces import Draw, Phase, TrajectoryDataset
from icrl_dist.methods.icag import ICAG
from icrl_dist.problems import registry
from icrl_dist.types import Job


class Experts(ICAG):
    """Collects the data of ICAG, and fits nothing."""

    name = "experts"
    trains = False

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        if not isinstance(registry.of(run).contexts(run).payload, ExpertHistories):
            yield "method", run.method, f"{run.problem} does not use SAC experts: use dpt, icag or icaa"

    def phases(self, run: Run) -> tuple[Phase, ...]:
        return (Phase("pretrain", 0, 0, run.optim.learning_rate),)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """ICAG's jobs, without the check of ``sac.least_return``: nothing is taught here, and the end of the run names them."""
        return tuple(_unchecked(job) for job in super().ask(run, phase))

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Raises ValueError: the phase has no steps, so there are no batches."""
        raise ValueError("method 'experts' trains no model")


def _unchecked(job: Job) -> Job:
    payload = job.payload
    assert isinstance(payload, ExpertHistories), "``objections`` refuses other runs"
    sac = dataclasses.replace(payload.sac, least_return=0.0, least_return_disturbed=0.0)
    return dataclasses.replace(job, payload=dataclasses.replace(payload, sac=sac))
