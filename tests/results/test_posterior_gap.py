"""The return of an agent beside that of the exact agent (``results.posterior``)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.config.sections import AdversaryConfig, EvaluateConfig
from icrl_dist.interfaces import Batch, MakePolicy, Policy
from icrl_dist.problems import registry
from icrl_dist.results import posterior, statistics
from icrl_dist.results.evaluate import Agent
from icrl_dist.results.tables import gap_table
from icrl_dist.types import NULL, Adversary, Task, Variation
from tests.results.row_blocks import frame


@pytest.fixture
def run(small_run: Run) -> Run:
    """ICAG with two adversaries a goal: 7 goals to train on, 2 held out."""
    return dataclasses.replace(small_run, method="icag", adversary=AdversaryConfig(count=1))


def gap(model: np.ndarray, exact: np.ndarray, p: float = 0.0) -> dict[str, Any]:
    """The gap of two agents with these mean returns of two episodes, by goal and seed."""
    return posterior.gap(model[:, :, None] * [0.5, 1.5], exact[:, :, None] * [0.5, 1.5], p)


def gaps(run: Run, act: MakePolicy, goals: Sequence[Task]) -> dict[str, dict[str, Any]]:
    """The gaps of a policy to the exact agent on these goals, by way of result rows."""
    found = posterior.online(run, (Agent("t0"), act), goals)
    return posterior.gaps(frame(*(one.block(run, "run", "test") for one in found), suite="posterior"))


def test_a_gap_is_a_ratio_of_means_of_pairs() -> None:
    rng = np.random.default_rng(0)
    exact = rng.uniform(1, 100, size=(6, 2))
    scaled = gap(0.8 * exact, exact)
    assert [scaled[k] for k in ("gap", "low", "high")] == pytest.approx([-0.2] * 3), (
        "goals and seeds were not resampled in pairs"
    )
    assert [scaled["model"], scaled["exact"]] == pytest.approx([0.8 * exact.mean(), exact.mean()])
    noisy = 0.8 * exact + rng.normal(0, 3, size=exact.shape) + [8, -8]
    found = gap(noisy, exact)
    assert found["gap"] == pytest.approx(noisy.sum() / exact.sum() - 1)
    slow = []
    for _ in range(4000):
        above = below = 0.0
        for goal in rng.integers(0, 6, size=6):  # with all its evaluations
            above, below = above + noisy[goal].sum(), below + exact[goal].sum()
        slow.append(above / below - 1)
    half = 2.571 * np.std(slow, ddof=1) * np.sqrt(6 / 5)  # Student's t with 5 degrees of freedom
    low, high = found["gap"] - half, found["gap"] + half
    assert [found["low"], found["high"]] == pytest.approx([low, high], abs=0.1 * (high - low))


def test_the_interval_covers_the_true_gap_and_not_much_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 300)
    rng, covered, widths, gaps = np.random.default_rng(0), 0, [], []
    for _ in range(200):
        exact = rng.uniform(20, 100, size=(20, 1)) + rng.normal(0, 5, size=(20, 2))
        found = gap(0.9 * exact + rng.normal(0, 5, size=(20, 2)), exact)
        covered += found["low"] <= -0.1 <= found["high"]
        widths.append(found["high"] - found["low"])
        gaps.append(found["gap"])
    assert 0.88 < covered / 200 <= 1
    assert np.mean(widths) < 2 * 2 * 1.96 * np.std(gaps)


def test_a_return_of_0_of_the_exact_agent_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"return is 0 at p = 0\.4: no ratio to it; try more --episodes"):
        gap(np.ones((2, 2)), np.zeros((2, 2)), 0.4)


def test_a_gap_without_an_interval_is_shown_as_such() -> None:
    """One goal and seed leave nothing to resample; exact returns of 0 in most goals give undefined resamples."""
    for exact in (np.ones((1, 1)), np.array([[1.0], [0.0], [0.0]])):
        found = gap(exact / 2, exact)
        assert (found["gap"], found["low"], found["high"]) == (-0.5, None, None) and json.dumps(found, allow_nan=False)
        found["draws"] = 1
        report = {"paper_gap": {"0": found}, "paper_gap_train": {"0": found}}
        assert list(gap_table(report, "").columns[-1].cells) == ["not shown"] * 2


def test_the_exact_agent_has_no_gap_to_itself_and_a_random_one_does(run: Run) -> None:
    run = dataclasses.replace(run, evaluate=EvaluateConfig(episodes=4, seeds=5, p=(0.0, 0.4), prior="uniform"))
    problem = registry.of(run)
    assert problem.exact is not None
    exact = problem.exact.agent(run, "paper")
    for goals in (problem.split.test, problem.split.train[:3]):
        batches: list[tuple[Variation, ...]] = []

        def act(rows: Sequence[Variation], env: Batch, batches: list[tuple[Variation, ...]] = batches) -> Policy:
            batches.append(tuple(rows))
            return exact(rows, env)

        same = gaps(run, act, goals)
        assert list(same) == ["0", "0.4"]
        assert all(row["gap"] == row["low"] == row["high"] == 0 and row["exact"] > 0 for row in same.values())
        for p, rows in zip((0.0, 0.4), batches, strict=True):
            adversary = Adversary.of("uniform", p=p) if p else NULL
            assert rows == tuple(Variation(problem.at_test_start(t), adversary) for t in goals for _ in range(5))
    worse = gaps(run, problem.references(run)["random"].make, problem.split.test)
    assert all(row["gap"] < -0.2 and row["low"] < row["gap"] for row in worse.values()), "two goals give wide intervals"
