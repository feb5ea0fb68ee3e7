"""The worst case of fixed policies: a SAC adversary that was trained against each of them alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac import draws
from icrl_dist.interfaces import Policy
from icrl_dist.types import Step

if TYPE_CHECKING:
    from icrl_dist.experts.sac.batched import SACBatch
    from icrl_dist.problems.parts import TwoPlayerBatch


class AgainstPolicy:
    """The adversary's own environments: a ``Batch`` in which the policy acts, and the reward is minus the agent's.

    The policy's ``observe`` is called only if it is to ``adapt``: else the context of an in-context policy stays as it is.
    """

    def __init__(self, env: TwoPlayerBatch, policy: Policy, adapt: bool = False) -> None:
        """``policy``: acts in the B environments of ``env``."""
        self._env, self._policy, self._adapt = env, policy, adapt
        self.spec, self.batch = dataclasses.replace(env.spec, actions=env.disturbance), env.batch
        self._shape = env.spec.horizon, env.spec.actions

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row; the policy's draws come from the row's generator, as in ``rollout.episode``."""
        self._observation = np.asarray(self._env.reset(rngs), np.float32)
        self._noise, self._number = np.stack([rng.random(self._shape) for rng in rngs], axis=1), 0
        return self._observation.copy()

    def step(self, actions: Float32[np.ndarray, "B F"]) -> Step:
        """Execute the adversary's actions, and the policy's."""
        chosen = self._policy.act(self._observation, self._noise[self._number])
        step = self._env.step(chosen, actions)
        if self._adapt:
            self._policy.observe(self._observation, chosen, step.reward, step.observation, step.done)
        self._observation, self._number = np.asarray(step.observation, np.float32), self._number + 1
        return step._replace(reward=-step.reward)


def adversary_seed(seed: int, number: int) -> int:
    """The seed of adversary ``number`` against a policy in the task whose expert has this seed."""
    words = draws.key(seed, draws.ADVERSARIES, number).generate_state(4, np.uint32)
    return int.from_bytes(words.tobytes(), "little")


def trained_adversaries(
    env: TwoPlayerBatch,
    policy: Policy,
    sac: SACConfig,
    steps: int,
    seeds: Sequence[int],
    progress: Callable[[int], None] = lambda steps: None,
    device: str = "auto",
) -> SACBatch:
    """A fresh adversary in each row of ``env``, trained for ``steps`` steps against the policy, which does not change.

    All train together, whichever policies act in the rows; an adversary does not depend on the other rows.
    ``progress`` is given the steps so far after every episode.
    """
    from icrl_dist.experts.sac.batched import train

    return train(AgainstPolicy(env, policy), sac, steps, seeds, lambda experts, returns: progress(experts.steps), device)


class Returns(NamedTuple):
    """Undiscounted returns of the agent."""

    returns: Float64[np.ndarray, "B E"]
    diverged: Bool[np.ndarray, "B E"]


def against(
    env: TwoPlayerBatch, policy: Policy, adversaries: SACBatch, seeds: Sequence[int], episodes: int, adapt: bool = False
) -> Returns:
    """Returns of the policy in ``episodes`` episodes of every row, against the mean actions of the row's adversary.

    The initial states depend on the row's seed alone, so policies with equal seeds start equally.  ``adapt``: the policy
    observes the transitions.
    """
    own, returns, diverged = AgainstPolicy(env, policy, adapt), [], []
    for episode in range(episodes):
        observation = own.reset([np.random.default_rng(draws.key(seed, draws.WINDOWS, episode)) for seed in seeds])
        total: Float[np.ndarray, " B"] = np.zeros(own.batch)
        for _ in range(own.spec.horizon):
            step = own.step(adversaries.act(observation))
            observation, total = np.asarray(step.observation, np.float32), total - step.reward
        returns.append(total)
        diverged.append(np.zeros(own.batch, bool) if step.diverged is None else step.diverged)
    return Returns(np.stack(returns, axis=1), np.stack(diverged, axis=1))
