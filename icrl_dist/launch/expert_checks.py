"""What is said about a run's SAC experts before it begins: experts that failed, and the memory that training takes."""

from __future__ import annotations

from collections.abc import Iterator

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.experts import memory, standing
from icrl_dist.problems import registry as problems
from icrl_dist.results import run_experts


def notes(run: Run) -> Iterator[str]:
    """Lines about the experts that this run uses or trains; none for a run without SAC experts.

    Raises ConfigError with a list if experts in the cache of this node return less than ``sac.least_return`` asks for, unless
    ``sac.failed_experts`` is ``teach`` or the run trains no model.  Workers check those that they train themselves.
    """
    jobs = run_experts.wanted(run)
    if not jobs:
        return
    if plugins.find("methods", run.method).trains and (text := standing.listed(run_experts.standings(run, jobs))):
        if run.sac.failed_experts == "refuse":
            raise ConfigError(f"{text}: no label was made of them; {standing.REMEDY}")
        yield f"labels are made although {text}"
    if largest := max((job for job in jobs if not all(one.stored for one in job)), key=len, default=[]):
        spec = problems.of(run).spec_of(largest[0].variation.task)
        yield memory.described(len(largest), spec, run.sac, largest[0].trials)
