"""The summary of a run that monitors show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Phase
from icrl_dist.types import Job


def about(run: Run, phases: Sequence[Phase], jobs: Sequence[Job]) -> dict[str, Any]:
    """Fields of the ``run`` message of the monitor plane (docs/tap.md); ``jobs``: those of all phases."""
    rows = {row for job in jobs for row in job.rows()}
    return {
        "method": run.method,
        "problem": run.problem,
        "phases": [[phase.stage, phase.round, phase.steps] for phase in phases],
        "rounds": sum(phase.stage == "adapt" for phase in phases),
        "tasks": len({task for task, _ in rows}),
        "variations": len(rows),
    }
