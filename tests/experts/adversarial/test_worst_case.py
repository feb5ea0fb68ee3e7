"""Fresh adversaries against fixed policies: what they see, what they learn, and the returns under them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.adversarial import worst_case
from icrl_dist.experts.adversarial.worst_case import AgainstPolicy, against, trained_adversaries
from icrl_dist.experts.sac import draws
from tests.experts.adversarial.games import HORIZON, SAC, Tug


class Sampling:
    """Moves to 0 with noise; it counts what it observes, and acts by that count if it learns."""

    def __init__(self, rows: int) -> None:
        self.seen = np.zeros(rows)

    def act(self, observation: np.ndarray, u: np.ndarray) -> np.ndarray:
        drift = 0.1 * self.seen[:, None]
        return np.clip(-0.5 * observation[:, :1] + 0.2 * (u - 0.5) + drift, -1, 1).astype(np.float32)

    def observe(self, observation: np.ndarray, action: np.ndarray, reward: np.ndarray, after: np.ndarray, done: bool) -> None:
        self.seen += done


def rngs(count: int) -> list[np.random.Generator]:
    return [np.random.default_rng(row) for row in range(count)]


def test_the_adversarys_environments_are_the_game_with_the_policy_in_it_and_opposite_rewards() -> None:
    policy, own = Sampling(2), AgainstPolicy(Tug([1.0, 2.0]), Sampling(2))
    assert (own.batch, own.spec.actions, own.spec.observation, own.spec.horizon) == (2, 2, 2, HORIZON)
    game, ours = Tug([1.0, 2.0]), rngs(2)
    observation = game.reset(ours)
    noise = [rng.random((HORIZON, 1)) for rng in ours]
    np.testing.assert_array_equal(own.reset(rngs(2)), observation)
    pushes = np.random.default_rng(5)
    for h in range(HORIZON):
        push = pushes.uniform(-1, 1, (2, 2)).astype(np.float32)
        step = game.step(policy.act(observation, np.stack([one[h] for one in noise])), push)
        found = own.step(push)
        np.testing.assert_array_equal(found.observation, step.observation)
        np.testing.assert_array_equal(found.reward, -step.reward)
        observation = step.observation
    assert found.done


def test_returns_are_those_of_a_loop_over_episodes_and_only_an_adapting_policy_observes() -> None:
    seeds = [worst_case.adversary_seed(3, number) for number in range(2)]
    adversaries = trained_adversaries(Tug([1.0, 2.0]), Sampling(2), SAC, 3 * HORIZON, seeds, device="cpu")
    assert adversaries.steps == 3 * HORIZON and adversaries.updates > 0
    for adapt in (False, True):
        policy = Sampling(2)
        found = against(Tug([1.0, 2.0]), policy, adversaries, seeds, 3, adapt)
        assert policy.seen.tolist() == ([3, 3] if adapt else [0, 0])
        other = Sampling(2)
        for episode in range(3):
            game, ours = Tug([1.0, 2.0]), [np.random.default_rng(draws.key(seed, draws.WINDOWS, episode)) for seed in seeds]
            observation, total = game.reset(ours), np.zeros(2)
            noise = [rng.random((HORIZON, 1)) for rng in ours]
            for h in range(HORIZON):
                push = adversaries.act(observation)
                step = game.step(other.act(observation, np.stack([one[h] for one in noise])), push)
                observation, total = step.observation, total + step.reward
            if adapt:
                other.seen += 1
            np.testing.assert_allclose(found.returns[:, episode], total, atol=1e-5)
        assert not found.diverged.any() and found.returns.shape == (2, 3)


def test_an_adversary_does_not_depend_on_the_other_rows_and_its_number_changes_its_seed() -> None:
    seeds = [worst_case.adversary_seed(3, number) for number in range(3)]
    assert len({*seeds, worst_case.adversary_seed(4, 0)}) == 4
    whole = trained_adversaries(Tug([1.0, 2.0, 1.0]), Sampling(3), SAC, 4 * HORIZON, seeds, device="cpu")
    alone = trained_adversaries(Tug([2.0]), Sampling(1), SAC, 4 * HORIZON, seeds[1:2], device="cpu")
    np.testing.assert_array_equal(whole.arrays["actor"][1].numpy(), alone.arrays["actor"][0].numpy())


@pytest.mark.integration
def test_an_adversary_learns_to_push_with_its_whole_strength_and_no_policy_is_worse_off_without_it() -> None:
    rates: dict[str, Any] = {"actor_rate": 1e-2, "critic_rate": 1e-2, "temperature_rate": 1e-2}
    sac = SACConfig(hidden=(16,), batch=32, random_steps=70, warmup=70, update_every=1, replay=2000, gamma=0.9, **rates)
    steps, seeds = 900, [worst_case.adversary_seed(0, number) for number in range(2)]
    reported = list[int]()
    adversaries = trained_adversaries(Tug([1.0, 0.0]), Sampling(2), sac, steps, seeds, reported.append, "cpu")
    assert reported[-1] == steps
    trained = against(Tug([1.0, 0.0]), Sampling(2), adversaries, seeds, 5)
    fresh = dataclasses.replace(sac, warmup=10**6)  # never updated
    untrained = trained_adversaries(Tug([1.0, 0.0]), Sampling(2), fresh, HORIZON, seeds, device="cpu")
    weak = against(Tug([1.0, 0.0]), Sampling(2), untrained, seeds, 5)
    # At full strength, -2 a step, a row that cannot move loses 2 (1 + 2 + ... + 7) = 56.
    assert (trained.returns.mean(axis=1) < weak.returns.mean(axis=1) - 10).all() and trained.returns[1].mean() < -45
