"""RARL (Pinto et al., 2017): one robust policy a task, trained against an adversary that learns; no in-context model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.run import Run
from icrl_dist.experts.adversarial.payloads import RobustPolicies
from icrl_dist.experts.payloads import WINDOW_EPISODES
from icrl_dist.interfaces import Draw, Phase, TrajectoryDataset
from icrl_dist.methods import jobs
from icrl_dist.methods.dpt import DPT
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import robust
from icrl_dist.types import Job


class RARL(DPT):
    """Trains and stores the robust policies; later tables have them as reference agents, and IC2RL its labels."""

    name = "rarl"
    section: ClassVar[str] = "robust"
    Config: ClassVar[type] = RobustConfig
    trains = False
    product = "rarl"
    curriculum: ClassVar[bool] = False
    """Whether the adversary's temperature follows QARL's curriculum."""

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        if registry.of(run).second_player is None:
            remedy = f"{run.problem} has no second player, which {run.method} trains as adversary: use dpt or icag"
            yield "method", run.method, remedy
        if not run.sac.cache:
            yield "sac.cache", "", f"{run.method} keeps its policies only there: name a folder"

    def phases(self, run: Run) -> tuple[Phase, ...]:
        return (Phase("pretrain", 0, 0, run.optim.learning_rate),)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Jobs that train the policies of a few tasks each, and deliver undisturbed episodes of them."""
        problem = registry.of(run)
        chosen = [self.training_variations(run, i, task, 0) for i, task in enumerate(problem.split.train)]
        payload = RobustPolicies(run.sac, robust.game(problem, run, self.curriculum))
        return jobs.grouped(run, phase, chosen, WINDOW_EPISODES, payload)

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Raises ValueError: the phase has no steps, so there are no batches."""
        raise ValueError(f"method {self.name!r} trains no in-context model")
