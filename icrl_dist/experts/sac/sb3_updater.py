"""One update of soft actor-critic for a single expert by stable-baselines3, on the arrays of ``SACBatch``."""

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
from icrl_dist.experts.sac.replay import ReplayBatch
from icrl_dist.types import Spec


class SB3Updater:
    """The counterpart of ``lockstep.Lockstep`` for one expert: ``stable_baselines3.SAC.train`` with a given batch and noise."""

    def __init__(self, arrays: Mapping[str, Tensor], shapes: sb3_files.Shapes, spec: Spec, config: SACConfig) -> None:
        """``arrays``: ``SACBatch.arrays`` of one expert on the CPU; changed in place."""
        model: Any = sb3_files.blank(spec, config)
        model.set_logger(configure(None, []))
        self._noise = model.actor.action_dist = _FixedNoiseGaussian(spec.actions)
        self._buffer = model.replay_buffer = _FixedBatchBuffer()
        sb3_files.share(model, shapes, arrays)
        self._model, self._batch = model, config.batch

    def refresh(self, updates: int) -> None:
        """Call after other code has changed parameters and moments; ``updates`` is the number of updates that they had."""
        sb3_files.set_updates(self._model, updates)

    def update(self, batch: ReplayBatch, noise: Float[Tensor, "2 1 B A"]) -> None:
        """Update temperature, critics, actor and target critics once each."""
        self._buffer.batch, self._noise.noise = batch, iter(noise[:, 0])
        self._model.train(1, self._batch)


class _FixedBatchBuffer:
    """A replay buffer whose sample is the batch that was set."""

    batch: ReplayBatch

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        observations, actions, rewards, next_observations = (column[0] for column in self.batch)
        return ReplayBufferSamples(observations, actions, next_observations, torch.zeros(batch_size, 1), rewards.unsqueeze(1))


class _FixedNoiseGaussian(SquashedDiagGaussianDistribution):
    """Samples with the noise that was set: first for the observations, then for the next observations."""

    noise: Iterator[Tensor]

    def sample(self) -> Tensor:
        self.gaussian_actions = self.distribution.mean + self.distribution.stddev * next(self.noise)
        return self.gaussian_actions.tanh()
