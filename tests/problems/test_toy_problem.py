"""The corridor of ``tests/toys`` and variants of it: what a problem of another package may lack or do otherwise."""

from typing import Any

import pytest
import torch

from icrl_dist.agent import ood_score
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.collect import kinds
from icrl_dist.collect.adapt import LabelledRollouts
from icrl_dist.collect.behavior import BehaviorContexts
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from tests.jobs import NoWeights
from tests.toys.corridor import CorridorConfig, CorridorProblem


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


@pytest.mark.parametrize(
    ("labelling", "message"),
    [
        (None, "payload.labelling = None: expected a table"),
        ([5, 8], r"payload.labelling = \[5, 8\]: expected a table"),
        ("cells", "payload.labelling = 'cells': expected a table"),
        ({"cells": 5, "rows": 2}, "unknown key payload.labelling.rows"),
        ({"cells": "5"}, "payload.labelling.cells = '5': expected int"),
        ({"cells": 0}, "payload.labelling.cells = 0: must be above 0"),
    ],
)
def test_the_labelling_of_a_payload_is_decoded_strictly(toy_run, labelling, message):
    problem = registry.of(toy_run())
    rest: dict[str, dict[str, Any]] = {
        "behavior_context": {"behaviors": ["random"]},
        "adapt_labelled": {"context_max": 9, "deploy": "paper", "decoder": "auto", "explore": 0.0, "explore_from": 0},
    }
    for kind, fields in rest.items():
        payload = kinds.read_payload(kind, problem, {**fields, "labelling": {"cells": 5}})
        assert isinstance(payload, BehaviorContexts | LabelledRollouts) and payload.labelling == CorridorConfig(cells=5)
        with pytest.raises(ValueError, match=message):
            kinds.read_payload(kind, problem, {**fields, "labelling": labelling})


def test_a_job_that_needs_a_part_which_the_problem_lacks_names_the_part(toy_run):
    run = toy_run()
    job, *_ = methods.of(run).ask(run, methods.of(run).phases(run)[0])
    for part in ("labeller", "behaviors"):
        problem = type("Lacking", (CorridorProblem,), {part: None})("toy-corridor", CorridorConfig())
        with pytest.raises(ValueError, match=f"job kind 'behavior_context': toy-corridor lacks Problem.{part}"):
            kinds.do(job, problem, methods.of(run), NoWeights(), "w")
