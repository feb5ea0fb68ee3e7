"""The corridor of ``tests/toys`` and variants of it: what a problem of another package may lack or do otherwise."""

import torch

from icrl_dist.agent import ood_score
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from tests.toys.corridor import CorridorProblem


def untrained(run):
    torch.manual_seed(0)
    spec, method = registry.of(run).spec, methods.of(run)
    return TrainedModel(run, method, spec, method.build(spec, run).eval())


def test_the_ood_score_is_calibrated_in_environments_of_the_runs_own_section(toy_run):
    cells = []

    class OwnSection(CorridorProblem):
        def batch(self, variations):
            cells.append(self.config.cells)
            return super().batch(variations)

    for method in ("icag", "icaa"):
        ood_score.calibrate(untrained(toy_run(method=method, problem=OwnSection)))
    assert cells == [5] * 4, "twice two halves of the tasks"
