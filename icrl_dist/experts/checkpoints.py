"""Which parameters of an expert's training act as the expert: the best of the last few checkpoints, by evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32, Float64

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.payloads import checkpoint_numbers
from icrl_dist.experts.sac import draws
from icrl_dist.interfaces import Batch

if TYPE_CHECKING:
    from icrl_dist.experts.sac.batched import SACBatch


class Checkpoints:
    """The actors of N experts at the checkpoints of their training."""

    def __init__(self, config: SACConfig, episodes: int) -> None:
        """``episodes``: of the whole training."""
        taken = checkpoint_numbers(config, episodes)
        self._taken, self._episodes = (taken if len(taken) > 1 else []), config.checkpoint_episodes
        self._actors: dict[int, np.ndarray] = {}

    def keep(self, episode: int, actors: Float32[np.ndarray, "N P"]) -> None:
        """Keep a copy of the parameters after this episode (from 1), if it is one of the checkpoints."""
        if episode in self._taken:
            self._actors[episode] = actors.copy()

    def state(self) -> dict[str, np.ndarray]:
        """The kept parameters by episode, for ``load``."""
        return {str(episode): actors for episode, actors in self._actors.items()}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue with the parameters that ``state`` returned."""
        self._actors = {int(episode): actors for episode, actors in state.items()}

    def choose(self, env: Batch, seeds: Sequence[int], experts: SACBatch, progress: Callable[[str], None]) -> None:
        """Give each expert its parameters at the checkpoint with the highest mean return; of equal ones the last.

        ``env`` has a row for each expert.  All checkpoints start from the same states, which belong to no other evaluation.
        With one checkpoint nothing changes.
        """
        if not self._actors:
            return
        actors, actor, returns = [self._actors[episode] for episode in sorted(self._actors)], experts.arrays["actor"], []
        for number, one in enumerate(actors, 1):
            progress(f"evaluating checkpoint {number} of {len(actors)}")
            actor.copy_(torch.from_numpy(one))
            returns.append(evaluate(env, experts.act, seeds, draws.CHECKPOINTS, self._episodes).mean(axis=0))
        chosen = len(actors) - 1 - np.stack(returns)[::-1].argmax(axis=0)
        actor.copy_(torch.from_numpy(np.stack(actors)[chosen, np.arange(len(chosen))]))


def evaluate(
    env: Batch, act: Callable[[np.ndarray], np.ndarray], seeds: Sequence[int], purpose: int, episodes: int
) -> Float64[np.ndarray, "E N"]:
    """Returns of E episodes in each row of ``env``, in which ``act(observations)`` gives the actions (N, A).

    Row n starts from states that are drawn with ``seeds[n]`` for this ``purpose`` (``sac.draws``).  After a simulation has
    diverged, its rewards count as 0.
    """
    returns = np.zeros((episodes, env.batch))
    for episode in range(episodes):
        observation = env.reset([np.random.default_rng(draws.key(seed, purpose, episode)) for seed in seeds])
        for _ in range(env.spec.horizon):
            step = env.step(act(observation))
            returns[episode] += step.reward if step.diverged is None else np.where(step.diverged, 0.0, step.reward)
            observation = step.observation
    return returns
