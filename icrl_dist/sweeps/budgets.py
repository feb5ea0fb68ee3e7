"""What the training of a run costs, for comparisons with equal budgets."""

from __future__ import annotations

from icrl_dist.config.run import Run
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry

QUANTITIES = ("training_episodes", "environment_steps", "optimizer_steps")
"""The quantities that are compared; columns of result rows."""


def of(run: Run) -> dict[str, int]:
    """Episodes and environment steps that the training collects, and optimizer steps of its fits."""
    method = methods.of(run)
    phases = method.phases(run)
    episodes = sum(len(job.variations) * job.trials for phase in phases for job in method.ask(run, phase))
    return {
        "training_episodes": episodes,
        "environment_steps": episodes * registry.of(run).horizon,
        "optimizer_steps": sum(phase.steps for phase in phases),
    }
