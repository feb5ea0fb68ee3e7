"""The environment benchmark: it counts what it says, and refuses what it does not know."""

from __future__ import annotations

import json

import pytest

from icrl_dist.bench import env
from icrl_dist.config.run import ConfigError


def test_it_reports_its_rate() -> None:
    result = env.run(batch=8, seconds=0.02)
    assert (result["problem"], result["batch"], result["seconds"]) == ("darkroom", 8, 0.02)
    # Checked shapes make it slow here: the number itself is the bench's business, its order is not.
    assert 1e2 < result["seeded_steps_per_s"] < 1e7
    assert 1e2 < result["steps_per_s"] < 1e7
    assert json.loads(json.dumps(result)) == result
    assert f"{result['steps_per_s'] / 1e6:.1f} million steps/s" in env.describe(result)


def test_every_row_is_disturbed(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    real = env.registry.batch
    monkeypatch.setattr(env.registry, "batch", lambda variations: seen.extend(variations) or real(variations))
    env.run(batch=32, seconds=0.001)
    assert len(seen) == 32
    assert all(v.adversary.kind == "dirichlet" and v.adversary.number("p") > 0 for v in seen)
    assert len({v.adversary for v in seen}) == 32


@pytest.mark.parametrize("problem", ["dmc-reacher-hard", "metaworld-pick-place"])
def test_a_simulated_problem_is_held_to_its_library_and_to_raw_physics(problem: str) -> None:
    result = env.run(problem, batch=1, seconds=0.01)
    assert (result["problem"], result["batch"]) == (problem, 1)
    assert result["ratio"] == pytest.approx(result["steps_per_s"] / result["plain_steps_per_s"])
    assert result["limit_ratio"] == pytest.approx(result["steps_per_s"] / result["mj_step_steps_per_s"])
    assert result["mj_step_steps_per_s"] > result["plain_steps_per_s"] > 1e2
    assert json.loads(json.dumps(result)) == result
    assert f"{result['ratio']:.2f} times its library's own loop" in env.describe(result)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"problem": "lightroom"}, r"problem = 'lightroom'.*choose one of darkroom"),
        ({"problem": "dmc-walker-rum"}, r"did you mean 'dmc-walker-run'"),
        ({"batch": 0}, r"batch = 0"),
        ({"seconds": 0.0}, r"seconds = 0\.0"),
    ],
)
def test_what_it_cannot_measure_is_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        env.run(**wrong)
