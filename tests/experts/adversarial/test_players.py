"""Two SAC players on one simulation: who learns when, what each remembers, and QARL's given temperature."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.adversarial import schedule
from icrl_dist.experts.adversarial import train as training
from icrl_dist.experts.adversarial.train import Players, train
from icrl_dist.experts.sac.batched import SACBatch
from icrl_dist.experts.sac.replay import ReplayBatch
from icrl_dist.types import Spec
from tests.experts.adversarial.games import HORIZON, ROBUST, SAC, Tug

SEEDS = (3, 4)
EPISODES = 12


def players_of(
    which: str, seeds: tuple[int, ...] = SEEDS, gains: tuple[float, ...] = (1.0, 2.0), report: Any = None
) -> Players:
    bounds = None if which == "rarl" else np.full(len(seeds), -1e9)
    return train(Tug(gains), SAC, ROBUST, seeds, bounds, report or (lambda players, returns: None), "cpu")


@pytest.mark.parametrize("which", ["rarl", "qarl"])
def test_only_the_learner_of_an_episode_changes_and_it_has_an_update_every_second_step(which: str) -> None:
    seen = list[tuple[dict[str, np.ndarray], dict[str, int]]]()

    def note(players: Players, returns: np.ndarray) -> None:
        both = {"protagonist": players.protagonist, "adversary": players.adversary}
        seen.append(
            ({k: one.arrays["actor"].numpy().copy() for k, one in both.items()}, {k: o.updates for k, o in both.items()})
        )
        assert both["protagonist"].steps == both["adversary"].steps == HORIZON * len(seen) and returns.shape == (2,)

    players = players_of(which, report=note)
    assert len(seen) == schedule.episodes(HORIZON, SAC, ROBUST) == EPISODES
    expected = {"protagonist": 0, "adversary": 0}
    for episode in range(EPISODES):
        learner = "adversary" if episode % 3 == 0 else "protagonist"
        for step in range(HORIZON * episode + 1, HORIZON * (episode + 1) + 1):
            expected[learner] += step > 10 and step % 2 == 0
        (actors, updates) = seen[episode]
        assert updates == expected
        if episode >= 2:
            changed = {name: (actors[name] != seen[episode - 1][0][name]).any(axis=1) for name in actors}
            for name in actors:
                assert changed[name].all() if name == learner else not changed[name].any()
    assert players.protagonist.updates > players.adversary.updates > 0


@pytest.mark.parametrize("which", ["rarl", "qarl"])
def test_both_replays_hold_every_step_and_the_rewards_are_opposite(which: str) -> None:
    players = players_of(which)
    extra = int(which == "qarl")
    own, theirs = (one.replay.state()["rows"] for one in (players.protagonist, players.adversary))
    S = 2 + extra
    assert own.shape == (2, EPISODES * HORIZON, 2 * S + 1 + 1) and theirs.shape == (2, EPISODES * HORIZON, 2 * S + 2 + 1)
    np.testing.assert_array_equal(own[..., :S], theirs[..., :S])
    np.testing.assert_array_equal(own[..., S + 1], -theirs[..., S + 2])
    np.testing.assert_array_equal(own[..., S + 2 :], theirs[..., S + 3 :])
    moved = own[..., 0] + np.array([[1.0], [2.0]], np.float32) * own[..., S] + theirs[..., S] - theirs[..., S + 1]
    np.testing.assert_allclose(own[..., S + 2], moved, atol=1e-5)
    np.testing.assert_allclose(own[..., S + 1], own[..., S + 2], atol=1e-6)
    if extra:
        temperatures = own[..., 2].reshape(2, EPISODES, HORIZON)
        assert (temperatures == temperatures[..., :1]).all() and len(np.unique(temperatures)) == 2 * EPISODES
        np.testing.assert_array_equal(own[..., -1], own[..., 2])
        assert temperatures[:, -3:].mean() < temperatures[:, :2].mean(), "bounds that always hold lower the temperature"


@pytest.mark.parametrize("which", ["rarl", "qarl"])
def test_a_tasks_players_do_not_depend_on_the_other_tasks(which: str) -> None:
    whole, alone = players_of(which), players_of(which, SEEDS[1:], (2.0,))
    for one, other in ((whole.protagonist, alone.protagonist), (whole.adversary, alone.adversary)):
        for name, array in other.arrays.items():
            np.testing.assert_array_equal(array[0].numpy(), one.arrays[name][1].numpy(), err_msg=name)
    again = players_of(which)
    np.testing.assert_array_equal(again.protagonist.arrays["actor"].numpy(), whole.protagonist.arrays["actor"].numpy())


def test_the_seeds_of_the_players_differ() -> None:
    seeds = {training.player_seed(seed, player) for seed in (0, 1, 2**127) for player in schedule.PLAYERS}
    assert len(seeds) == 6 and not seeds & {0, 1, 2**127}


def test_at_test_the_protagonist_of_qarl_is_given_the_temperature_0() -> None:
    players, observation = players_of("qarl"), np.random.default_rng(0).normal(size=(2, 5, 2)).astype(np.float32)
    with_zero = np.concatenate([observation, np.zeros((2, 5, 1), np.float32)], axis=2)
    np.testing.assert_array_equal(players.act(observation), players.protagonist.act(with_zero))
    assert (players.act(observation) != players.protagonist.act(with_zero + np.array([0, 0, 0.05], np.float32))).any()


# The adversary's given temperature.

WIDE = Spec((-1.0,) * 3, (1.0,) * 3, 2, 9, discrete=False)
UPDATED = SACConfig(hidden=(8, 8), batch=4, replay=10, critic_rate=1e-12, actor_rate=1e-3)


def batch_of(temperature: list[float], rng: torch.Generator) -> tuple[ReplayBatch, torch.Tensor]:
    count = len(temperature)
    observations, following = torch.randn(2, 1, count, 3, generator=rng)
    for one in (observations, following):
        one[..., -1] = torch.tensor(temperature)
    actions = torch.rand(1, count, 2, generator=rng) * 2 - 1
    return ReplayBatch(observations, actions, torch.randn(1, count, generator=rng), following), torch.randn(
        2, 1, count, 2, generator=rng
    )


def updated(config: SACConfig, batch: ReplayBatch, noise: torch.Tensor, given: bool) -> dict[str, torch.Tensor]:
    engine = SACBatch([5], WIDE, config, "cpu", given_temperature=given)
    engine.update(batch, noise)
    return engine.arrays


def test_an_update_at_a_given_temperature_is_sacs_at_this_temperature_which_is_not_learned() -> None:
    batch, noise = batch_of([0.25] * 4, torch.Generator().manual_seed(0))
    ours = updated(dataclasses.replace(UPDATED, temperature=0.7), batch, noise, True)
    sacs = updated(dataclasses.replace(UPDATED, temperature=0.25), batch, noise, False)
    for name in ("actor", "critic", "actor/exp_avg", "critic/exp_avg", "target"):
        torch.testing.assert_close(ours[name], sacs[name], rtol=1e-5, atol=1e-9)
    assert float(ours["log_temperature"].exp()) == pytest.approx(0.7) and float(sacs["log_temperature"].exp()) != 0.25


def test_each_transition_has_its_own_temperature() -> None:
    """Gradients are means over transitions, so they are the mean of those of single transitions."""
    batch, noise = batch_of([0.0, 0.1, 0.4, 3.0], torch.Generator().manual_seed(1))
    whole, single = updated(UPDATED, batch, noise, True), dataclasses.replace(UPDATED, batch=1)
    parts = [
        updated(single, ReplayBatch(*(column[:, i : i + 1] for column in batch)), noise[:, :, i : i + 1], True)
        for i in range(4)
    ]
    for name in ("actor/exp_avg", "critic/exp_avg"):
        mean = torch.stack([part[name] for part in parts]).mean(0)
        torch.testing.assert_close(whole[name], mean, rtol=1e-4, atol=1e-7)
