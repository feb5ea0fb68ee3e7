"""ICAG (section 4.1, Algorithm 2): all variations of every task, labels from each variation's own optimal policy."""

from __future__ import annotations

from icrl_dist.config.run import Run
from icrl_dist.methods.dpt import DPT
from icrl_dist.problems import registry
from icrl_dist.types import Task, Variation


class ICAG(DPT):
    """DPT over tasks x adversaries, with the labels of eq. (5)."""

    name = "icag"

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """All variations; DAgger rounds use those of D_pre."""
        return registry.training_variations(run, index, task, round)
