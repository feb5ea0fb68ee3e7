"""Algorithm 1: deploying a policy offline and online, in a whole batch of environments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Float32, Int16, Int64

from icrl_dist.config import ConfigError, ContextConfig, Deployment, default_deployment
from icrl_dist.envs import Batch
from icrl_dist.models.dpt import Deployed, PretrainedTransformer, Stretches, Transitions
from icrl_dist.models.heads import sample

Actions = Int64[np.ndarray, " B"] | Float32[np.ndarray, "B A"]
"""Of B environments: numbers, or vectors in [-1, 1]."""


class Policy(Protocol):
    """Acts in B environments at once, by its law over discrete actions; whatever it learns, it learns from ``observe``."""

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

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The actions that these uniform numbers in [0, 1) pick: one a row, or one a component."""
        return self.model.reads.act(self._decide(observation), u)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        """The law over discrete actions."""
        return self._decide(observation).softmax(-1).cpu().numpy()

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float[torch.Tensor, "B O"]:
        return self._deployed.decide(torch.from_numpy(np.array(observation)).to(self.model.low.device))

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Actions,
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._pending.append((observation, action, next_observation, reward))
        if done:
            self._add(self._episode())

    def _episode(self) -> Transitions:
        """The episode that has just ended."""
        columns = [np.stack(column, axis=1) for column in zip(*self._pending, strict=True)]
        self._pending = []
        return Transitions(*self._tensors(*columns))

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int64[np.ndarray, "B T"] | Float32[np.ndarray, "B T A"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add one episode, of this or any other policy, to the context."""
        self._add(Transitions(*self._tensors(observations, actions, next_observations, rewards)))

    def _add(self, episode: Transitions) -> None:
        if not self._remember(episode):
            self._deployed.append(episode)

    def _tensors(self, *columns: np.ndarray) -> Iterator[torch.Tensor]:
        return (torch.from_numpy(np.array(column)).to(self.model.low.device) for column in columns)

    def _remember(self, episode: Transitions) -> bool:
        """Add an episode to those of the context; true if others were dropped for it, and all was encoded anew."""
        kept = [] if self._config.keep == "last" else list(self._episodes)
        total = sum(e.actions.shape[1] for e in kept) + episode.actions.shape[1]
        while kept and total > self._config.max:
            total -= kept.pop(0).actions.shape[1]
        dropped, self._episodes = len(kept) < len(self._episodes), [*kept, episode]
        if dropped:
            self._deployed.clear()
            self._deployed.append(Transitions(*(torch.cat(columns, dim=1) for columns in zip(*self._episodes, strict=True))))
        return dropped


class CommittedPolicy(InContextPolicy):
    """T_theta(. | s, D_on, zeta): every transition joins the context at once, and a guess once acted on is kept.

    zeta are the last states and actions of the episode, as if the optimal policy had taken
    them (eq. 6): what T_theta has begun to do it goes on with, unless the context has come to
    speak against it.  Then the guess is refuted and zeta is empty again.  It is refuted when
    T_theta, knowing what it knows now, would hardly have done what it did: when that has become
    ``REFUTED`` times as likely as it was.
    """

    REFUTED = 0.5

    def __init__(self, model: PretrainedTransformer, batch: int, context: ContextConfig) -> None:
        super().__init__(model, batch, context)
        spec, length = model.spec, model.config.stretch
        self._rows = np.arange(batch)
        self._states = np.zeros((batch, length, spec.observation), np.float32)
        shape, dtype = ((), np.int64) if spec.discrete else ((spec.actions,), np.float32)
        self._taken = np.zeros((batch, length, *shape), dtype)
        self._said = np.zeros((batch, length))
        self._kept = np.zeros(batch, np.int64)
        self._arrived: Transitions | None = None

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float[torch.Tensor, "B O"]:
        outputs, taken = self._follow(observation, self._kept)
        decided = outputs[self._rows, self._kept]
        now = self.model.reads.log_likelihood(outputs, taken).double().cpu().numpy()
        past = np.arange(now.shape[1]) < self._kept[:, None]
        change = np.where(past, now - self._said[:, : now.shape[1]], 0.0).sum(axis=1)
        refuted = change < math.log(self.REFUTED)
        if refuted.any():
            self._kept[refuted] = 0
            anew, _ = self._follow(observation, np.zeros_like(self._kept))
            decided[torch.from_numpy(refuted)] = anew[:, 0][torch.from_numpy(refuted)]
        self._decided = decided
        return decided

    def _follow(
        self, observation: Float32[np.ndarray, "B S"], kept: Int64[np.ndarray, " B"]
    ) -> tuple[Float[torch.Tensor, "B L O"], torch.Tensor]:
        """Outputs at the first ``kept`` states of zeta and at this observation after them; and the actions of zeta."""
        length = int(kept.max()) + 1
        states = self._states[:, :length].copy()
        states[self._rows, kept] = observation
        of = Stretches(*(column[:, None] for column in self._tensors(states, self._taken[:, :length])))
        arrived, self._arrived = self._arrived, None
        return self._deployed.follow(of, arrived), of.taken[:, 0]

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Actions,
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._pending.append((observation, action, next_observation, reward))
        self._arrived = Transitions(*(column[:, None] for column in self._tensors(*self._pending[-1])))
        self._keep(observation, action)
        if done:
            episode = self._episode()
            self._kept[:] = 0
            if not self._remember(episode):
                self._follow(observation, self._kept)  # the last transition arrives
            self._arrived = None
            self._deployed.settle()

    def _keep(self, observation: Float32[np.ndarray, "B S"], action: Actions) -> None:
        """Add a step to zeta, which lets go of its first where it is full."""
        chosen, at = torch.from_numpy(np.array(action)).to(self._decided.device), (self._rows, self._kept)
        self._states[at], self._taken[at] = observation, action
        self._said[at] = self.model.reads.log_likelihood(self._decided, chosen).double().cpu().numpy()
        self._kept += 1
        full = self._kept == self._states.shape[1]
        for column in (self._states, self._taken, self._said):
            column[full] = np.roll(column[full], -1, axis=1)
        self._kept[full] -= 1


def in_context(
    model: PretrainedTransformer, batch: int, context: ContextConfig, deploy: Deployment | None = None
) -> InContextPolicy:
    """T_theta deployed by this rule, or by the better one that it was trained for.

    Raises ConfigError for ``committed`` if it was not trained on stretches.
    """
    rule = deploy or default_deployment(model.config)
    if rule == "committed" and model.config.stretch == 1:
        raise ConfigError(
            "deploy 'committed': this agent never trained on stretches (model.stretch = 1); "
            "deploy it by 'paper', or train with model.stretch, pretrain.stretches and optim.stretches"
        )
    return {"paper": InContextPolicy, "committed": CommittedPolicy}[rule](model, batch, context)


@dataclass(frozen=True, eq=False)
class Episodes:
    """One episode in each of B environments."""

    actions: Int16[np.ndarray, "B H"] | Float32[np.ndarray, "B H A"]
    observations: Float32[np.ndarray, "B H+1 S"]
    rewards: Float32[np.ndarray, "B H"]
    adversary: Int16[np.ndarray, "B H"]

    @property
    def returns(self) -> Float[np.ndarray, " B"]:
        """Undiscounted return of each episode."""
        return self.rewards.sum(axis=1, dtype=np.float64)


def _act(policy: Policy | InContextPolicy, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
    if isinstance(policy, InContextPolicy):
        return policy.act(observation, u)
    return sample(policy.probabilities(observation), u[:, 0])


def episode(env: Batch, policy: Policy | InContextPolicy, rngs: Sequence[np.random.Generator]) -> Episodes:
    """One episode; row b's chance, the agent's included, comes from ``rngs[b]`` alone."""
    observation = env.reset(rngs)
    shape = (env.spec.horizon, 1 if env.spec.discrete else env.spec.actions)
    noise = np.stack([rng.random(shape) for rng in rngs], axis=1)
    observations, actions, rewards, adversary = [observation], [], [], []
    for h in range(env.spec.horizon):
        action = _act(policy, observation, noise[h])
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
