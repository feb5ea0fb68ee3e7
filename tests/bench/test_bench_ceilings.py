"""``bench ceilings``: shares of the optimum against a slow evaluation, and the table of returns."""

from __future__ import annotations

import json

import pytest

from icrl_dist.bench import ceilings
from icrl_dist.config.run import Run, override
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room, solver
from icrl_dist.problems.darkroom.adversaries import SYMMETRIES
from icrl_dist.problems.darkroom.bench import kept
from icrl_dist.problems.darkroom.solver import Hypotheses
from icrl_dist.types import Adversary, Variation
from tests.problems.darkroom.test_solver import slow_q, slow_return


@pytest.mark.parametrize("disturbance", ceilings.DISTURBANCES)
def test_the_kept_share_equals_the_recursion(disturbance: str) -> None:
    p, size, horizon, earned, best = 0.7, 3, 6, 0.0, 0.0
    for goal in [(x, y) for x in range(size) for y in range(size)]:
        task = room.task(goal, size, horizon)
        policy = solver.soft_labels(Hypotheses.of([Variation(task)]), 0.99, 1e-9)[0]
        adversaries = {
            "override": [Adversary.of("uniform", p=p)],
            "wind": [Adversary.of("wind", p=p, direction=d) for d in range(4)],
            "permuted": [Adversary.of("permuted", p=p, permutation=s) for s in SYMMETRIES],
        }[disturbance]
        for variation in (Variation(task, adversary) for adversary in adversaries):
            earned += slow_return(variation, policy)
            best += max(slow_q(variation, (0, 0), horizon, 1.0, {}))
    assert kept(disturbance, size, horizon, p) == pytest.approx(earned / best)
    assert kept(disturbance, size, horizon, 0.0) == pytest.approx(1.0)


def test_it_prints_every_agent_at_every_strength(small_run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ceilings, "STRENGTHS", (0.5,))
    monkeypatch.setattr(ceilings, "ROOMS", ((3, 9),))
    monkeypatch.setattr(
        ceilings,
        "_run",
        lambda disturbance, split, seeds: override(
            small_run, [f"darkroom.disturbance={disturbance}", "evaluate.p=[0.0, 0.5]", "evaluate.seeds=2"], "test"
        ),
    )
    result = ceilings.run(quick=True)
    assert json.loads(json.dumps(result)) == result
    rows = {(row["disturbance"], row["agent"], row["p"]): row["return"] for row in result["returns"]}
    assert len(rows) == len(ceilings.DISTURBANCES) * len(ceilings.AGENTS) * 2
    horizon = registry.of(small_run).spec.horizon
    for disturbance in ceilings.DISTURBANCES:
        assert 0 <= rows[disturbance, "random", 0.5] < rows[disturbance, "oracle", 0.5] <= horizon
        assert rows[disturbance, "oracle", 0.0] == rows["override", "oracle", 0.0], "p = 0 is no disturbance"
    text = ceilings.describe(result)
    assert text.count("exact:icag-committed") == 3 and "permuted, 3x3, 9 steps" in text
