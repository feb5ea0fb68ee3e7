"""Soft actor-critic by stable-baselines3 with the paper's settings: the reference, and the default for a single expert.

stable-baselines3 has one learning rate, and one setting for both random steps and warm-up; ``Expert``
has separate ones, as in the paper.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
from stable_baselines3.common.noise import ActionNoise
from torch.optim import Optimizer

from icrl_dist.config.sac import SACConfig


class Expert(stable_baselines3.SAC):
    """``stable_baselines3.SAC`` with a learning rate per part, and random steps separate from the warm-up.

    ``stable_baselines3.SAC.load`` also opens its files.  It executes what a file says, so load only your own files with
    it; ``SACBatch.load_sb3`` reads those of others without executing anything.
    """

    rates: tuple[float, float, float] = (SACConfig.actor_rate, SACConfig.critic_rate, SACConfig.temperature_rate)
    """Learning rates of actor, critics and temperature."""
    random_steps: int = SACConfig.random_steps

    def _update_learning_rate(self, optimizers: list[Optimizer] | Optimizer) -> None:
        for optimizer, rate in zip(optimizers if isinstance(optimizers, list) else [optimizers], self.rates, strict=True):
            for group in optimizer.param_groups:
                group["lr"] = rate

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        return super()._sample_action(self.random_steps, action_noise, n_envs)


def expert(env: gymnasium.Env[Any, Any], config: SACConfig, seed: int | None, device: str = "auto") -> Expert:
    """An untrained expert: call ``expert(...).learn(steps)``, then ``save(path)``.

    The target bootstraps through ``truncated`` ends of episodes, which are time limits.  With a
    ``seed``, stable-baselines3 seeds torch's, numpy's and Python's global generators.
    """
    model = Expert(
        "MlpPolicy",
        env,
        learning_rate=config.critic_rate,
        buffer_size=config.replay,
        learning_starts=config.warmup,
        batch_size=config.batch,
        tau=config.tau,
        gamma=config.gamma,
        train_freq=config.update_every,
        ent_coef=f"auto_{config.temperature!r}",
        policy_kwargs={"net_arch": list(config.hidden)},
        seed=seed,
        device=device,
    )
    model.rates = (config.actor_rate, config.critic_rate, config.temperature_rate)
    model.random_steps = config.random_steps
    return model
