"""The suite ``worst``: its rows against a slow loop, and its summary against counting."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import EvaluateConfig
from icrl_dist.experts.adversarial import worst_case
from icrl_dist.experts.cache import expert_seed
from icrl_dist.interfaces import Batch, MakePolicy, Reference
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.results import heldout, worst
from icrl_dist.results.evaluate import Agent
from icrl_dist.types import Variation
from tests.jobs import in_problem
from tests.optional import known
from tests.results.row_blocks import frame, rendered, unwrapped

HORIZON, STEPS = 10, 40


class Counting:
    """Turns the joints by the number of episodes that it observed."""

    def __init__(self, rows: int) -> None:
        self.seen = np.zeros(rows)

    def act(self, observation: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.tile(np.clip(0.2 * self.seen, -1, 1)[:, None], 2).astype(np.float32)

    def observe(self, observation: np.ndarray, action: np.ndarray, reward: np.ndarray, after: np.ndarray, done: bool) -> None:
        self.seen += done


def counting(rows: Sequence[Variation], env: Batch) -> Counting:
    return Counting(len(rows))


@pytest.fixture
def reacher(small_run: Run) -> Run:
    return in_problem(
        small_run,
        "dmc-reacher-easy",
        method="dpt",
        control=ControlConfig(train_tasks=4, test_tasks=2, horizon=HORIZON, strength=0.5),
        sac=SACConfig(hidden=(8,), batch=16, random_steps=10, warmup=20, update_every=2, cache=""),
        evaluate=EvaluateConfig(p=(0.5,), episodes=2, seeds=1),
    )


@pytest.mark.integration
def test_rows_are_those_of_adversaries_that_a_loop_trains_one_after_another(reacher: Run) -> None:
    agents: dict[Agent, MakePolicy | Reference] = {
        Agent("t0", "paper", 0, "digest"): counting,
        Agent("rarl"): Reference(counting),
    }
    made = frame(*worst.blocks(reacher, agents, 2, STEPS, "run"), suite="worst")
    problem = registry.of(reacher)
    assert set(zip(made["agent"], made["data"], strict=True)) == {
        *(("t0", data) for data in ("", "frozen", "adapting")),
        *(("rarl", data) for data in ("", "frozen")),
    }
    assert len(made) == (3 + 2) * 4 * 2 * 2 and set(made["p"]) == {0.0, 0.5}
    for p, task_index, number in ((0.5, 3, 1),):
        task = problem.evaluated[task_index]
        game = known(problem.second_player).batch([task], p * 0.5)
        seeds = [worst_case.adversary_seed(expert_seed(Variation(task), reacher.seed), number)]
        policy = Counting(1)
        policy.seen += 2  # the undisturbed episodes
        trained = worst_case.trained_adversaries(game, policy, reacher.sac, STEPS, seeds)
        each = {
            "frozen": worst_case.against(game, policy, trained, seeds, 2),
            "adapting": worst_case.against(game, Counting(1), trained, seeds, 2, adapt=True),
        }
        for data, found in each.items():
            own = made[(made["p"] == p) & (made["task_index"] == task_index) & (made["adversary_index"] == number)]
            own = own[(own["agent"] == "t0") & (own["data"] == data)].sort_values("episode")
            np.testing.assert_allclose(own["return"], found.returns[0], atol=1e-5)
            assert set(own["adversary_family"]) == {"sac"} and set(own["deployment"]) == {"paper"}
    assert set(made.loc[made["p"] == 0.0, "adversary_family"]) == {"null"}


def test_the_summary_has_the_mean_and_the_worst_of_each_tasks_adversaries(
    reacher: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    monkeypatch.setattr(worst_case, "trained_adversaries", lambda *arguments: None)

    def against(
        game: object, policy: object, trained: None, seeds: Sequence[int], episodes: int, adapt: bool = False
    ) -> object:
        return worst_case.Returns(rng.random((len(seeds), episodes)), np.zeros((len(seeds), episodes), bool))

    monkeypatch.setattr(worst_case, "against", against)
    agents: dict[Agent, MakePolicy | Reference] = {
        Agent("t0", "paper", 0, "digest"): counting,
        Agent("expert"): Reference(counting, ceiling=True),
    }
    made = frame(*worst.blocks(reacher, agents, 2, STEPS, "run"), suite="worst")
    found = worst.summary(made)
    assert [(row["p"], row["key"]) for row in found] == [(0.5, "t0"), (0.5, "expert")]
    for row in found:
        for data, prefix in (("frozen", ""), ("adapting", "adapting_")):
            own = made[(made["p"] == row["p"]) & (made["agent"] == row["key"]) & (made["data"] == data)]
            if row["key"] == "expert" and data == "adapting":
                assert row["adapting_mean"] is row["adapting_worst"] is None
                continue
            means = [
                [own[(own["task_index"] == i) & (own["adversary_index"] == k)]["return"].mean() for k in range(2)]
                for i in range(4)
            ]
            assert row[f"{prefix}mean"] == pytest.approx(np.mean(means), abs=1e-3)
            assert row[f"{prefix}worst"] == pytest.approx(np.mean([min(one) for one in means]), abs=1e-3)
            if not prefix:
                assert row["lowest"] == pytest.approx(min(min(one) for one in means), abs=1e-3)
        assert row["undisturbed"] == pytest.approx(
            made[(made["agent"] == row["key"]) & (made["data"] == "")]["return"].mean(), abs=1e-3
        )
    text = unwrapped(rendered(worst.table(found, "Adversaries", 2, STEPS, 2)))
    assert "SAC expert" in text and "2 SAC adversaries are trained for 40 steps" in text


def test_what_has_no_second_player_or_no_strength_is_refused(small_run: Run, reacher: Run) -> None:
    with pytest.raises(ConfigError, match=r"--suite worst: darkroom has no second player .* use --suite online"):
        heldout.check_suite(small_run, "worst")
    still = dataclasses.replace(reacher, evaluate=dataclasses.replace(reacher.evaluate, p=(0.0, 1.0)))
    with pytest.raises(ConfigError, match="--suite worst: at p = 0 there is no adversary"):
        heldout.check_suite(still, "worst")
