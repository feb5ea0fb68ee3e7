"""One update of soft actor-critic for a single expert, by stable-baselines3 itself, on parameters that somebody else owns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from jaxtyping import Float
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac import sb3_files
from icrl_dist.experts.sac.replay import Transitions
from icrl_dist.types import Spec


class Reference:
    """What ``lockstep.Lockstep`` is for several: ``stable_baselines3.SAC.train``, given batch and noise."""

    def __init__(self, arrays: Mapping[str, Tensor], shapes: sb3_files.Shapes, spec: Spec, config: SACConfig) -> None:
        """``arrays`` are those of ``SACBatch.arrays``, of one expert on the CPU, and are changed in place."""
        model: Any = sb3_files.blank(spec, config)
        model.set_logger(configure(None, []))
        self._noise = model.actor.action_dist = _Given(spec.actions)
        self._handed = model.replay_buffer = _Handed()
        sb3_files.share(model, shapes, arrays)
        self._model, self._batch = model, config.batch

    def refresh(self, updates: int) -> None:
        """Take up parameters and moments that somebody else has changed, after so many updates."""
        sb3_files.count(self._model, updates)

    def update(self, batch: Transitions, noise: Float[Tensor, "2 1 B A"]) -> None:
        """Temperature, critics, actor and target critics, each once."""
        self._handed.batch, self._noise.noise = batch, iter(noise[:, 0])
        self._model.train(1, self._batch)


class _Handed:
    """A replay buffer that hands out what it was given."""

    batch: Transitions

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        seen, acted, rewards, following = (column[0] for column in self.batch)
        return ReplayBufferSamples(seen, acted, following, torch.zeros(batch_size, 1), rewards.unsqueeze(1))


class _Given(SquashedDiagGaussianDistribution):
    """Actions at the noise that it was given: those of the observations, then those of the following ones."""

    noise: Iterator[Tensor]

    def sample(self) -> Tensor:
        self.gaussian_actions = self.distribution.mean + self.distribution.stddev * next(self.noise)
        return self.gaussian_actions.tanh()
