"""What a worker's memory must hold while it trains the experts of one job, computed before the start."""

from __future__ import annotations

import itertools
from typing import NamedTuple

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.cache import recorded_episodes, training_episodes
from icrl_dist.types import Spec

PROCESS = 500e6
"""Bytes of a worker before it trains: Python, torch and the simulator."""
LIMIT = 4e9
"""Bytes above which a message names the settings that need less."""


class Memory(NamedTuple):
    """Bytes of a worker that trains N experts on the CPU."""

    replay: float
    """The replays, and their copy while a checkpoint of the training is written."""
    networks: float
    """Parameters, Adam's moments, gradients and activations."""
    episodes: float
    """Recorded episodes, and their copies when the histories are made; the draws of one episode."""

    @property
    def total(self) -> float:
        """With the process itself."""
        return PROCESS + sum(self)


def needed(experts: int, spec: Spec, config: SACConfig, trials: int) -> Memory:
    """The memory of a job of ``trials`` trials for so many experts; on a GPU the replays are in its memory instead."""
    S, A, B = spec.observation, spec.actions, config.batch
    episodes = training_episodes(spec.horizon, config)
    capacity = min(config.replay, episodes * spec.horizon)
    replay = capacity * (2 * S + A + 1) * (2 if config.cache else 1)
    actor, critic = ((S, *config.hidden, 2 * A), (S + A, *config.hidden, 1))
    parameters = 4 * _parameters(actor) + 10 * _parameters(critic)  # value, gradient, 2 moments; 2 critics with targets
    activations = 2 * B * 2 * (sum(actor) + sum(critic))  # of both critics, and of the actor at both observations
    steps = recorded_episodes(spec.horizon, config, trials) * spec.horizon
    recorded = 3 * steps * (S + 2 * A + 4)
    drawn = 2 * -(-spec.horizon // config.update_every) * B * (2 + 2 * A)
    return Memory(*(4.0 * experts * values for values in (replay, parameters + activations, recorded + drawn)))


def _parameters(sizes: tuple[int, ...]) -> int:
    return sum((rows + 1) * columns for rows, columns in itertools.pairwise(sizes))


def described(experts: int, spec: Spec, config: SACConfig, trials: int) -> str:
    """One line for the user, before a run begins; above ``LIMIT`` it names the settings that need less."""
    found = needed(experts, spec, config, trials)
    width = "x".join(map(str, config.hidden)) if len(set(config.hidden)) > 1 else f"{len(config.hidden)}x{config.hidden[0]}"
    text = (
        f"a worker trains up to {experts} SAC experts of {width} at once and needs about {found.total / 1e9:.1f} GB of memory, "
        f"{found.replay / 1e9:.1f} GB of it for replays"
    )
    remedy = "; smaller stream.job_tasks, sac.replay, or fewer --actors need less" if found.total > LIMIT else ""
    return text + remedy
