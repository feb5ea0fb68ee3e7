"""Algorithm 1: deploying a policy offline and online, in a whole batch of environments."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Float32, Int16, Int64

from icrl_dist.config import ContextConfig
from icrl_dist.envs import Batch
from icrl_dist.models.dpt import Deployed, PretrainedTransformer, Transitions


class Policy(Protocol):
    """Acts in B environments at once; whatever it learns, it learns from ``observe``."""

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]: ...

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int64[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None: ...


class RandomPolicy:
    """Uniform over the actions: the behaviour policy of the pretraining contexts."""

    def __init__(self, actions: int) -> None:
        self._uniform = np.full(actions, 1.0 / actions)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        return np.broadcast_to(self._uniform, (len(observation), len(self._uniform)))

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""


class InContextPolicy:
    """T_theta(. | s, D_on): the context is frozen within an episode and grows at its end.

    Lines 10 to 17 of Algorithm 1.  A context that outgrows ``context.max`` drops its oldest
    whole episodes and is encoded anew, for kept keys have seen what was dropped.
    """

    def __init__(self, model: PretrainedTransformer, batch: int, context: ContextConfig) -> None:
        self.model, self.batch, self._config = model, batch, context
        self._episodes: list[Transitions] = []
        self._pending: list[tuple[np.ndarray, ...]] = []
        self._deployed = Deployed(model, batch)

    @property
    def length(self) -> int:
        """Transitions in the context of each environment."""
        return self._deployed.length

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        states = torch.from_numpy(np.array(observation)).to(self.model.low.device)
        return self._deployed.decide(states).softmax(-1).cpu().numpy()

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Int64[np.ndarray, " B"],
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._pending.append((observation, action, next_observation, reward))
        if done:
            stacked = [np.stack(column, axis=1) for column in zip(*self._pending, strict=True)]
            self._pending = []
            self.append(stacked[0], stacked[1], stacked[2], stacked[3])

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int64[np.ndarray, "B T"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Append an episode, or any data D_off collected before, to every context."""
        device = self.model.low.device
        episode = Transitions(
            *(
                torch.from_numpy(np.array(a)).to(device)
                for a in (observations, actions.astype(np.int64), next_observations, rewards)
            )
        )
        kept = [] if self._config.keep == "last" else list(self._episodes)
        total = sum(e.actions.shape[1] for e in kept) + episode.actions.shape[1]
        while kept and total > self._config.max:
            total -= kept.pop(0).actions.shape[1]
        dropped, self._episodes = len(kept) < len(self._episodes), [*kept, episode]
        if dropped:
            self._deployed.clear()
            episode = Transitions(*(torch.cat(columns, dim=1) for columns in zip(*self._episodes, strict=True)))
        self._deployed.append(episode)


@dataclass(frozen=True, eq=False)
class Episodes:
    """One episode in each of B environments."""

    actions: Int16[np.ndarray, "B H"]
    observations: Float32[np.ndarray, "B H+1 S"]
    rewards: Float32[np.ndarray, "B H"]
    adversary: Int16[np.ndarray, "B H"]

    @property
    def returns(self) -> Float[np.ndarray, " B"]:
        """Undiscounted return of each episode."""
        return self.rewards.sum(axis=1, dtype=np.float64)


def sample(probabilities: Float[np.ndarray, "B A"], u: Float[np.ndarray, " B"]) -> Int64[np.ndarray, " B"]:
    """The action of each row that its uniform number u in [0, 1) picks."""
    edges = probabilities.astype(np.float64).cumsum(axis=1)
    return (u[:, None] * edges[:, -1:] >= edges[:, :-1]).sum(axis=1)


def episode(env: Batch, policy: Policy, rngs: Sequence[np.random.Generator]) -> Episodes:
    """One episode; row b's chance, the agent's included, comes from ``rngs[b]`` alone."""
    observation = env.reset(rngs)
    noise = np.stack([rng.random(env.spec.horizon) for rng in rngs], axis=1)
    observations, actions, rewards, adversary = [observation], [], [], []
    for h in range(env.spec.horizon):
        action = sample(policy.probabilities(observation), noise[h])
        step = env.step(action)
        policy.observe(observation, action, step.reward, step.observation, step.done)
        observation = step.observation
        observations.append(observation)
        actions.append(action.astype(np.int16))
        rewards.append(step.reward)
        adversary.append(step.adversary)
    return Episodes(
        observations=np.stack(observations, axis=1),
        actions=np.stack(actions, axis=1),
        rewards=np.stack(rewards, axis=1),
        adversary=np.stack(adversary, axis=1),
    )


def deploy_online(env: Batch, policy: Policy, trials: Iterable[Sequence[np.random.Generator]]) -> Iterator[Episodes]:
    """Lines 9 to 17: one episode a trial, the context growing from nothing."""
    for rngs in trials:
        yield episode(env, policy, rngs)


def deploy_offline(
    env: Batch, policy: InContextPolicy, dataset: Sequence[Episodes], rngs: Sequence[np.random.Generator]
) -> Episodes:
    """Lines 3 to 7: one episode given D_off, which was collected before by other policies."""
    for data in dataset:
        policy.append(data.observations[:, :-1], data.actions.astype(np.int64), data.observations[:, 1:], data.rewards)
    return episode(env, policy, rngs)
