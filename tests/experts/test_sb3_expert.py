"""One expert by stable-baselines3: it has the paper's settings, and a time limit is not a terminal state."""

import gymnasium
import numpy as np
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.type_aliases import TrainFreq

from icrl_dist.config.run import ConfigError, make_run, validate
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.sb3_expert import Expert, expert
from tests.calls import noting
from tests.optional import known

CONFIG = SACConfig(hidden=(8, 4), batch=6, random_steps=10, warmup=20, replay=100, update_every=3)


class Corridor(gymnasium.Env):
    """Three steps along a line with reward 1 each, then the time limit."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.at = 0
        return np.array([0, 0], np.float32), {}

    def step(self, action):
        self.at += 1
        return np.array([self.at, action[0]], np.float32), 1.0, False, self.at == 3, {}


def rates(model):
    optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)
    return tuple(optimizer.param_groups[0]["lr"] for optimizer in optimizers)


def test_an_expert_has_the_papers_settings():
    model = expert(Corridor(), SACConfig(replay=100), 0, "cpu")
    assert [m.out_features for m in model.actor.latent_pi if isinstance(m, torch.nn.Linear)] == [256] * 3
    for critic in model.critic.q_networks:
        assert [m.out_features for m in critic.children() if isinstance(m, torch.nn.Linear)] == [256, 256, 256, 1]
    for last in (model.actor.mu, model.actor.log_std):
        assert isinstance(last, torch.nn.Linear) and last.out_features == 1
    assert (model.tau, model.gamma, model.batch_size, model.learning_starts) == (0.005, 0.9, 256, 5000)
    assert known(model.log_ent_coef).exp().item() == pytest.approx(5e-3) and model.target_entropy == -1.0
    assert isinstance(model.train_freq, TrainFreq)
    assert (model.train_freq.frequency, model.gradient_steps, SACConfig().replay) == (3, 1, 1_000_000)


def test_each_part_keeps_its_own_learning_rate_through_training_and_a_file(tmp_path):
    model = expert(Corridor(), CONFIG, 0, "cpu")
    model.learn(30)
    assert rates(model) == (1e-4, 3e-4, 3e-4)
    model.save(tmp_path / "expert.zip")
    again = Expert.load(tmp_path / "expert.zip", Corridor(), device="cpu")
    again.learn(30)
    assert rates(again) == (1e-4, 3e-4, 3e-4)
    loaded = stable_baselines3.SAC.load(tmp_path / "expert.zip", device="cpu")
    observations = np.array([[1, 0.5], [-3, 1]], np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )


def test_first_actions_are_uniform_and_updates_begin_after_the_warm_up(monkeypatch):
    model = expert(Corridor(), CONFIG, 0, "cpu")
    steps = list[int]()
    monkeypatch.setattr(Expert, "predict", noting(steps, lambda self, *a, **k: self.num_timesteps, Expert.predict))
    model.learn(30)
    assert steps == list(range(10, 30))
    assert model._n_updates == 4  # after the steps 21, 24, 27 and 30


def test_the_time_limit_is_stored_as_not_terminal_with_the_observation_at_it():
    model = expert(Corridor(), CONFIG, 0, "cpu")
    model.learn(9)
    buffer = known(model.replay_buffer)
    assert buffer.dones[:9, 0].tolist() == [0, 0, 1] * 3
    assert buffer.next_observations[:9, 0, 0].tolist() == [1, 2, 3] * 3
    assert not buffer._get_samples(np.arange(9)).dones.any()


@pytest.mark.parametrize(
    "wrong", [{"batch": 0}, {"hidden": (64, 0)}, {"tau": 1.5}, {"gamma": 1.0}, {"warmup": 0}, {"replay": -1}]
)
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(ConfigError, match=rf"x: sac\.{next(iter(wrong))} = .*must be"):
        validate(make_run(sac=SACConfig(**wrong)), "x")
