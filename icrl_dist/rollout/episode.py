"""Algorithm 1 in a batch of environments: online episodes, and offline episodes given a dataset."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, Int64

from icrl_dist.interfaces import Batch, Policy


@dataclass(frozen=True, eq=False)
class Episodes:
    """One episode in each of B environments."""

    actions: Int16[np.ndarray, "B H"] | Float32[np.ndarray, "B H A"]
    observations: Float32[np.ndarray, "B H+1 S"]
    rewards: Float32[np.ndarray, "B H"]
    adversary: Int16[np.ndarray, "B H"] | Float32[np.ndarray, "B H F"]
    diverged: Bool[np.ndarray, " B"] | None = None
    """Rows whose simulation diverged: their episodes are not used for training.  None for a problem that cannot diverge."""

    @property
    def returns(self) -> Float[np.ndarray, " B"]:
        """Undiscounted return of each episode."""
        return self.rewards.sum(axis=1, dtype=np.float64)


def episode(env: Batch, policy: Policy, rngs: Sequence[np.random.Generator]) -> Episodes:
    """One episode; all draws of row b, also those of the policy, come from ``rngs[b]``."""
    observation = env.reset(rngs)
    shape = (env.spec.horizon, 1 if env.spec.discrete else env.spec.actions)
    noise = np.stack([rng.random(shape) for rng in rngs], axis=1)
    observations, actions, rewards, adversary = [observation], [], [], []
    for h in range(env.spec.horizon):
        action = policy.act(observation, noise[h])
        step = env.step(action)
        policy.observe(observation, action, step.reward, step.observation, step.done)
        observation = step.observation
        observations.append(observation)
        actions.append(action.astype(np.int16) if env.spec.discrete else action)
        rewards.append(step.reward)
        adversary.append(step.adversary)
    return Episodes(
        observations=np.stack(observations, axis=1),
        actions=np.stack(actions, axis=1),
        rewards=np.stack(rewards, axis=1),
        adversary=np.stack(adversary, axis=1),
        diverged=step.diverged,
    )


def deploy_online(env: Batch, policy: Policy, trials: Iterable[Sequence[np.random.Generator]]) -> Iterator[Episodes]:
    """Lines 9 to 17: one episode per trial; the context starts empty and grows."""
    for rngs in trials:
        yield episode(env, policy, rngs)


class OfflinePolicy(Policy, Protocol):
    """A policy whose context also accepts episodes of other policies."""

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int64[np.ndarray, "B T"] | Float32[np.ndarray, "B T A"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add one episode to the context."""
        ...


class FrozenPolicy(Protocol):
    """A policy that can be fixed within an episode, so that it is a Markov policy there."""

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> Float[np.ndarray, "P Q A"] | None:
        """Its distributions over discrete actions at any states in the next episode: P = B, by row, or P = 1, one for all rows.

        None if they change within an episode.  It is called between episodes, and the policy does not change.
        """
        ...


def deploy_offline(
    env: Batch, policy: OfflinePolicy, dataset: Sequence[Episodes], rngs: Sequence[np.random.Generator]
) -> Episodes:
    """Lines 3 to 7: one episode given D_off, which other policies collected."""
    append(env, policy, dataset)
    return episode(env, policy, rngs)


def append(env: Batch, policy: OfflinePolicy, dataset: Sequence[Episodes]) -> None:
    """Add D_off, which other policies collected, to the context."""
    for data in dataset:
        actions = data.actions.astype(np.int64) if env.spec.discrete else data.actions
        policy.append(data.observations[:, :-1], actions, data.observations[:, 1:], data.rewards)
