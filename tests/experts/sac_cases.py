"""Small experts, updates and environments for the tests of soft actor-critic."""

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.replay import ReplayBatch
from icrl_dist.types import Spec, Step

S, A, N = 17, 6, 3
SPEC = Spec((-10.0,) * S, (10.0,) * S, A, 200, discrete=False)
PAPER = SACConfig(replay=100)
SMALL = SACConfig(hidden=(16, 8), batch=12, replay=100, actor_rate=1e-3)


class Spaces(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-10, 10, (S,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (A,), np.float32)


def random_updates(config, updates, seed=0, experts=N):
    """Random batches and noise for ``updates`` updates."""
    g = torch.Generator().manual_seed(seed)
    B = config.batch
    for _ in range(updates):
        observations, next_observations = torch.randn(2, experts, B, S, generator=g)
        actions, rewards = torch.rand(experts, B, A, generator=g) * 2 - 1, torch.rand(experts, B, generator=g)
        yield ReplayBatch(observations, actions, rewards, next_observations), torch.randn(2, experts, B, A, generator=g)


class GivenBatches:
    """A replay buffer that returns given batches in order."""

    def __init__(self, batches):
        self.batches = batches

    def sample(self, batch_size, env):
        observations, actions, rewards, next_observations = next(self.batches)
        return ReplayBufferSamples(observations, actions, next_observations, torch.zeros(batch_size, 1), rewards[:, None])


def updated_by_sb3(model, index, batches, monkeypatch):
    """``model`` after stable-baselines3 has made the updates of expert ``index``."""
    batches = list(batches)
    noises = iter([noise[half, index] for _, noise in batches for half in (0, 1)])
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda shape, dtype, device: next(noises))
    model.set_logger(configure(None, []))
    model.replay_buffer = GivenBatches(iter([ReplayBatch(*(column[index] for column in batch)) for batch, _ in batches]))
    for _ in batches:
        model.train(1, model.batch_size)
    assert next(noises, None) is None
    return model


def max_difference(model, other, part):
    """Largest difference of two models' parameters."""
    pairs = zip(getattr(model, part).parameters(), getattr(other, part).parameters(), strict=True)
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


def optimizers(model):
    return [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]


def through_file(engine, index, path):
    """Expert ``index`` as stable-baselines3 loads it."""
    engine.save_sb3(index, path)
    return stable_baselines3.SAC.load(path, device="cpu")


LINE = SACConfig(hidden=(8,), batch=4, random_steps=5, warmup=9, update_every=3, replay=1000)


class Line:
    """N positions on a line.  Actions move them, each row draws its start, and the reward is the position."""

    def __init__(self, batch, horizon=7):
        self.spec, self.batch = Spec((-9.0, 0.0), (9.0, 9.0), 1, horizon, discrete=False), batch
        self.starts, self.actions_taken = [], []

    def _observation(self):
        return np.stack([self.at, np.full(self.batch, self.time)], axis=1).astype(np.float32)

    def reset(self, rngs):
        self.time, self.at = 0, np.array([rng.uniform(-1, 1) for rng in rngs], np.float32)
        self.starts.append(self.at)
        return self._observation()

    def step(self, actions):
        self.time, self.at = self.time + 1, self.at + actions[:, 0]
        self.actions_taken.append(actions)
        return Step(self._observation(), self.at, self.time == self.spec.horizon, np.full(self.batch, -1, np.int16))


class DivergingLine(Line):
    """The second row diverges at step 3, and its rewards are NaN from then on."""

    def step(self, actions):
        step = super().step(actions)
        diverged = np.array([False, self.time >= 3])
        return step._replace(reward=np.where(diverged, np.nan, step.reward).astype(np.float32), diverged=diverged)
