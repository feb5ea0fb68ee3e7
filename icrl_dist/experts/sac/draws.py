"""Random draws of experts that train in lockstep.  Each expert has its own generators, so draws do not depend on the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from torch import Tensor

from icrl_dist.config.sac import SACConfig
from icrl_dist.types import Spec

INITIALIZATION, STARTS, ACTIONS, UPDATES, WINDOWS, CHECKPOINTS, EVALUATION, PLAYERS, TEMPERATURES, ADVERSARIES = range(10)
"""The purpose of a generator: initial parameters, initial states, actions, updates, the episodes after training from which
action windows are cut, those by which checkpoints are compared, and those of an evaluation of the expert; of a game of
two players their seeds, and the adversary's temperatures; the seeds of adversaries that are trained against a fixed
policy."""


def key(seed: int, *purpose: int) -> np.random.SeedSequence:
    """The seed sequence of an expert's generator, by the expert's seed and the generator's purpose."""
    return np.random.SeedSequence(seed, spawn_key=purpose)


def generator(seed: int, *purpose: int, device: str | torch.device = "cpu") -> torch.Generator:
    """A torch generator, seeded by ``key``."""
    return torch.Generator(device).manual_seed(int(key(seed, *purpose).generate_state(1, np.uint64)[0] >> 1))


class EpisodeDraws:
    """All draws of one training episode of N experts."""

    def __init__(self, seeds: Sequence[int], episode: int, spec: Spec, config: SACConfig, updates: int, device: torch.device):
        """``updates`` is the number of updates in the episode."""
        self.starts = [np.random.default_rng(key(seed, STARTS, episode)) for seed in seeds]
        """Generators of the environments' initial states."""
        rngs, size = [np.random.default_rng(key(seed, ACTIONS, episode)) for seed in seeds], (spec.horizon, spec.actions)
        self.uniform: Float64[np.ndarray, "H N A"] = np.stack([rng.uniform(-1, 1, size) for rng in rngs], axis=1)
        """Actions of the random steps at the start of training."""
        self.normal: Float32[np.ndarray, "H N A"] = np.stack(
            [rng.standard_normal(size, dtype=np.float32) for rng in rngs], axis=1
        )
        """Noise of the policy's actions."""
        self.updates = update_draws(seeds, episode, (config.batch, spec.actions), updates, device)


def update_draws(
    seeds: Sequence[int], episode: int, shape: tuple[int, int], count: int, device: torch.device
) -> list[tuple[Int[Tensor, "N B"], Float32[Tensor, "2 N B A"]]]:
    """The draws of ``count`` updates, with ``shape`` (B, A): numbers of transitions (``Replay.take`` takes them modulo its
    length), and noise of the actions at the observations, then at the next observations.
    """
    (batch, actions), generators = shape, [generator(seed, UPDATES, episode, device=device) for seed in seeds]
    picks = [torch.randint(1 << 62, (count, batch), generator=own, device=device) for own in generators]
    noise = [torch.randn((count, 2, batch, actions), generator=own, device=device) for own in generators]
    return list(zip(torch.stack(picks, dim=1), torch.stack(noise, dim=2), strict=True))
