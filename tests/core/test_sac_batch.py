"""Experts in lockstep: the same numbers as stable-baselines3, and one that learns a real game."""

import stable_baselines3
import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.buffers import ReplayBufferSamples
from stable_baselines3.common.logger import configure

from icrl_dist.algos.replay import Replay, Transitions
from icrl_dist.algos.sac import SACConfig, expert
from icrl_dist.algos.sac_batch import SACBatch, pick
from icrl_dist.types import Spec

S, A, N = 17, 6, 3
SPEC = Spec((-10.0,) * S, (10.0,) * S, A, 200, discrete=False)
PAPER = SACConfig(replay=100)
SMALL = SACConfig(hidden=(16, 8), batch=12, replay=100, actor_rate=1e-3)


class Spaces(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-10, 10, (S,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (A,), np.float32)


def drawn(config, updates, seed=0, experts=N):
    """Batches and noise of so many updates."""
    g = torch.Generator().manual_seed(seed)
    B = config.batch
    for _ in range(updates):
        seen, following = torch.randn(2, experts, B, S, generator=g)
        acted, reward = torch.rand(experts, B, A, generator=g) * 2 - 1, torch.rand(experts, B, generator=g)
        yield Transitions(seen, acted, reward, following), torch.randn(2, experts, B, A, generator=g)


class Handed:
    """A replay buffer that hands out what it is given."""

    def __init__(self, batches):
        self.batches = batches

    def sample(self, batch_size, env):
        seen, acted, reward, following = next(self.batches)
        return ReplayBufferSamples(seen, acted, following, torch.zeros(batch_size, 1), reward[:, None])


def by_sb3(model, index, batches, monkeypatch):
    """``model`` after the updates of expert ``index``."""
    batches = list(batches)
    noises = iter([noise[half, index] for _, noise in batches for half in (0, 1)])
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda shape, dtype, device: next(noises))
    model.set_logger(configure(None, []))
    model.replay_buffer = Handed(iter([Transitions(*(column[index] for column in batch)) for batch, _ in batches]))
    for _ in batches:
        model.train(1, model.batch_size)
    assert next(noises, None) is None
    return model


def apart(model, other, part):
    """Largest difference of two models' parameters."""
    pairs = zip(getattr(model, part).parameters(), getattr(other, part).parameters(), strict=True)
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


def opened(engine, index, path):
    engine.save_sb3(index, path)
    return stable_baselines3.SAC.load(path, device="cpu")


@pytest.mark.parametrize(("updates", "actors", "critics"), [(1, 2e-6, 4e-5), (10, 6e-6, 4e-5), (50, 6e-4, 2e-4)])
def test_updates_are_those_of_stable_baselines3(updates, actors, critics, tmp_path, monkeypatch):
    engine = SACBatch(N, SPEC, PAPER, 0, "cpu")
    models = []
    for index in (0, N - 1):
        engine.save_sb3(index, tmp_path / "before.zip")
        models.append(type(expert(Spaces(), PAPER, 0, "cpu")).load(tmp_path / "before.zip", device="cpu"))
    for batch, noise in drawn(PAPER, updates):
        engine.update(batch, noise)
    for index, model in zip((0, N - 1), models, strict=True):
        by_sb3(model, index, drawn(PAPER, updates), monkeypatch)
        ours = opened(engine, index, tmp_path / "after.zip")
        print(updates, apart(ours, model, "actor"), apart(ours, model, "critic"), apart(ours, model, "critic_target"))
        assert apart(ours, model, "actor") <= 3 * actors
        assert apart(ours, model, "critic") <= 3 * critics
        assert apart(ours, model, "critic_target") <= 3 * critics
        assert ours.log_ent_coef.item() == pytest.approx(model.log_ent_coef.item(), abs=1e-5)
