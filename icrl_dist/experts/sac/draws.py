"""What is drawn for experts in lockstep, for each by generators of its own: nothing depends on an expert's company."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from torch import Tensor

from icrl_dist.config.sac import SACConfig
from icrl_dist.types import Spec

FIRST, STARTS, ACTIONS, UPDATES, LED = range(5)
"""What a generator is for: first parameters, episodes' beginnings, actions, updates, episodes led after the training."""


def key(seed: int, *what: int) -> np.random.SeedSequence:
    """What a generator of an expert with this seed begins from."""
    return np.random.SeedSequence(seed, spawn_key=what)


def generator(seed: int, *what: int, device: str | torch.device = "cpu") -> torch.Generator:
    """The same for torch."""
    return torch.Generator(device).manual_seed(int(key(seed, *what).generate_state(1, np.uint64)[0] >> 1))


class Chance:
    """All that is drawn in one episode of N experts."""

    def __init__(self, seeds: Sequence[int], episode: int, spec: Spec, config: SACConfig, updates: int, device: torch.device):
        """``updates``: so many are to be made in it."""
        self.starts = [np.random.default_rng(key(seed, STARTS, episode)) for seed in seeds]
        """The environments' generators."""
        acting, size = [np.random.default_rng(key(seed, ACTIONS, episode)) for seed in seeds], (spec.horizon, spec.actions)
        self.uniform: Float64[np.ndarray, "H N A"] = np.stack([rng.uniform(-1, 1, size) for rng in acting], axis=1)
        """Actions that are taken before there is anything to go by."""
        self.normal: Float32[np.ndarray, "H N A"] = np.stack(
            [rng.standard_normal(size, dtype=np.float32) for rng in acting], axis=1
        )
        """Noise of the actions that are taken."""
        self.updates = of_updates(seeds, episode, (config.batch, spec.actions), updates, device)


def of_updates(
    seeds: Sequence[int], episode: int, shape: tuple[int, int], count: int, device: torch.device
) -> list[tuple[Int[Tensor, "N B"], Float32[Tensor, "2 N B A"]]]:
    """What each update takes, ``shape`` being (B, A): transitions, by numbers to be read modulo those that there are;
    and noise of the actions at the observations, then at the following ones.
    """
    (batch, actions), given = shape, [generator(seed, UPDATES, episode, device=device) for seed in seeds]
    picks = [torch.randint(1 << 62, (count, batch), generator=one, device=device) for one in given]
    noise = [torch.randn((count, 2, batch, actions), generator=one, device=device) for one in given]
    return list(zip(torch.stack(picks, dim=1), torch.stack(noise, dim=2), strict=True))
