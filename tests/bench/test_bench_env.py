"""The environment benchmark: its rates and ratios, and the arguments that it refuses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import pytest

from icrl_dist.bench import env
from icrl_dist.config.run import ConfigError
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom.problem import DarkRoomProblem
from icrl_dist.types import Variation
from tests.calls import noting


def test_it_reports_rates() -> None:
    result = env.run(batch=8, seconds=0.02)
    assert (result["problem"], result["batch"], result["seconds"]) == ("darkroom", 8, 0.02)
    # The shape checks of tests make it slow, so only the order of magnitude is tested.
    assert 1e2 < result["seeded_steps_per_s"] < 1e7
    assert 1e2 < result["steps_per_s"] < 1e7
    assert json.loads(json.dumps(result)) == result
    assert f"{result['steps_per_s'] / 1e6:.1f} million steps/s" in env.describe(result)


def test_every_row_is_disturbed(monkeypatch: pytest.MonkeyPatch) -> None:
    batches = list[Sequence[Variation]]()
    monkeypatch.setattr(registry, "batch", noting(batches, lambda variations: variations, registry.batch))
    env.run(batch=32, seconds=0.001)
    rows = [row for batch in batches for row in batch]
    assert len(rows) == 32
    assert all(v.adversary.kind == "dirichlet" and v.adversary.number("p") > 0 for v in rows)
    assert len({v.adversary for v in rows}) == 32


@pytest.mark.parametrize("problem", ["dmc-reacher-hard", "metaworld-pick-place"])
def test_a_simulated_problem_is_compared_with_its_library_and_with_mj_step(problem: str) -> None:
    result = env.run(problem, batch=1, seconds=0.01)
    assert (result["problem"], result["batch"]) == (problem, 1)
    assert result["ratio"] == pytest.approx(result["steps_per_s"] / result["plain_steps_per_s"])
    assert result["limit_ratio"] == pytest.approx(result["steps_per_s"] / result["mj_step_steps_per_s"])
    assert result["mj_step_steps_per_s"] > result["plain_steps_per_s"] > 1e2
    assert json.loads(json.dumps(result)) == result
    assert f"{result['ratio']:.2f} times a loop over its library's environments" in env.describe(result)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"problem": "lightroom"}, r"problem = 'lightroom'.*choose one of darkroom"),
        ({"problem": "dmc-walker-rum"}, r"did you mean 'dmc-walker-run'"),
        ({"batch": 0}, r"batch = 0"),
        ({"seconds": 0.0}, r"seconds = 0\.0"),
    ],
)
def test_invalid_arguments_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        env.run(**wrong)


def test_a_problem_without_benchmarks_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DarkRoomProblem, "benchmarks", None)
    with pytest.raises(ConfigError, match=r"problem = 'darkroom'.*choose one of dmc-cartpole-balance"):
        env.run("darkroom")
