"""Soft actor-critic by stable-baselines3, with the paper's numbers: the reference, and the default for one expert.

stable-baselines3 has one learning rate and one number for both random steps and warm-up; ``Expert``
has the paper's own for each.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
from stable_baselines3.common.noise import ActionNoise
from torch.optim import Optimizer


@dataclasses.dataclass(frozen=True)
class SACConfig:
    """Table 1 of the paper; where it is silent or misprinted, QARL's code."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the hidden layers, ReLU, of the actor and of each of the two critics (Table 1)."""
    actor_rate: float = 1e-4
    """Adam's learning rate for the actor (Table 1)."""
    critic_rate: float = 3e-4
    """Adam's learning rate for the critics (Table 1)."""
    temperature_rate: float = 3e-4
    """Adam's learning rate for the logarithm of the temperature (Table 1)."""
    tau: float = 0.005
    """Share of the critics that the target critics take up at each update (Table 1)."""
    gamma: float = 0.9
    """Discount a step (section 5)."""
    batch: int = 256
    """Transitions an update (Table 1)."""
    random_steps: int = 3_000
    """Steps of uniformly random actions at the start (Table 1)."""
    warmup: int = 5_000
    """Steps before the first update (Table 1)."""
    replay: int = 1_000_000
    """Transitions remembered, at most (Table 1)."""
    temperature: float = 5e-3
    """The first temperature (QARL's code; Table 1's 5*10^3 has lost its sign).  The entropy that it
    is tuned to is -A for A action components."""
    update_every: int = 3
    """Steps an update (QARL's code)."""

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            least = 0 if name in ("random_steps", "warmup", "gamma") else np.nextafter(0, 1)
            if min(value, default=0) < least if isinstance(value, tuple) else value < least:
                raise ValueError(f"SAC: {name} = {value}: must be {'0 or more' if least == 0 else 'above 0'}")
        if self.warmup < 1 or self.tau > 1 or self.gamma >= 1:
            raise ValueError(
                f"SAC: warmup = {self.warmup}, tau = {self.tau}, gamma = {self.gamma}: must be at least 1, at most 1, below 1"
            )


class Expert(stable_baselines3.SAC):
    """``stable_baselines3.SAC`` with a learning rate for each part, and random steps apart from the warm-up.

    What it saves, ``stable_baselines3.SAC.load`` opens too.
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
    """An expert that has learned nothing yet: ``expert(...).learn(steps)``, then ``save(path)``.

    An episode that ends by ``truncated`` has met its time limit: the target bootstraps through it.
    With a ``seed`` stable-baselines3 seeds torch's, numpy's and Python's global generators.
    """
    made = Expert(
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
    made.rates = (config.actor_rate, config.critic_rate, config.temperature_rate)
    made.random_steps = config.random_steps
    return made
