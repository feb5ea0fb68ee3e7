"""A decision transformer deployed in a batch of environments."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int64

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig, Deployment
from icrl_dist.copies import CopiedWhole
from icrl_dist.interfaces import Actions
from icrl_dist.models.deployed import Columns
from icrl_dist.models.segments import Segments, returns_to_go
from icrl_dist.rollout.deployment import with_episode

if TYPE_CHECKING:
    from icrl_dist.models.dt import DecisionTransformer, Encoded


class PromptedPolicy(CopiedWhole):
    """Acts given the target return of the model; its prompt comes from the best episode in the context.

    The return-to-go at a step is the target less the rewards of this episode so far.  The window holds the last steps of
    this episode.  The prompt is empty until the first episode has ended, or ``append`` has added one.  It changes only
    between episodes, as the context does in Algorithm 1.
    """

    def __init__(self, model: DecisionTransformer, batch: int, context: ContextConfig) -> None:
        """The weights are copied.  ``context.keep = "last"``: the newest episode gives the prompt, not the best one."""
        self.model, self._config = copy.deepcopy(model).eval(), context
        spec, shape = model.spec, (batch, model.prompt)
        self._prompt = Segments(
            np.zeros(shape, np.float32),
            np.zeros((*shape, spec.observation), np.float32),
            np.zeros(shape, np.int64) if spec.discrete else np.zeros((*shape, spec.actions), np.float32),
            np.zeros(shape, np.int64),
            np.zeros(shape, bool),
        )
        self._best = np.full(batch, -np.inf)
        self._episodes: list[Columns] = []
        self._start()

    def _start(self) -> None:
        """Begin an episode."""
        self._encoded: Encoded | None = None  # the prompt
        self._known: Encoded | None = None  # the prompt and the first ``_count`` steps of this episode
        self._count = 0
        self._steps: list[tuple[np.ndarray, ...]] = []  # return-to-go, observation and action of each step so far
        self._outcomes: list[tuple[np.ndarray, ...]] = []  # next observation and reward of each step so far
        self._to_go = np.full(len(self._best), self.model.target.item(), np.float32)

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The actions: discrete ones are those that the uniform numbers in [0, 1) select."""
        return self.model.act(self._decide(observation), u)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        """The distribution over discrete actions."""
        return self.model.probabilities(self._decide(observation))

    def distribution(self, states: Float32[np.ndarray, "Q S"], row: int = 0) -> Float[np.ndarray, "Q A"]:
        """The distribution over discrete actions if environment ``row`` were in each of these states at its next decision."""

        def of(column: np.ndarray) -> np.ndarray:
            return np.repeat(column[row : row + 1], len(states), axis=0)

        steps = [tuple(map(of, step)) for step in self._steps[self._first() :]]
        to_go, _, nothing = map(of, self._now(states))
        encoded = self.model.encode_frozen(Segments(*map(of, self._prompt)))
        return self.model.probabilities(self.model.decide(encoded, self._window([*steps, (to_go, states, nothing)]))[0])

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """Observations (T, S), actions (T), next observations (T, S) and rewards (T) of the ended episodes of an environment.

        The newest ones, at most ``context.max`` transitions; the prompt may be of an older episode, if that was better.
        """
        if self._episodes:
            ended = zip(*([column[row] for column in episode] for episode in self._episodes), strict=True)
            return tuple(np.concatenate(column) for column in ended)
        observations, actions = self._prompt.observations[row, :0], self._prompt.actions[row, :0]
        return observations, actions, observations, self._prompt.to_go[row, :0]

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B A"]:
        """Within the first window of an episode a decision costs the newest step; later the window loses its first step."""
        if self._encoded is None:
            self._encoded = self._known = self.model.encode_frozen(self._prompt)
            self._count = 0
        assert self._known is not None
        now, first = self._now(observation), self._first()
        if len(self._steps) < self.model.window:
            outputs, self._known = self.model.decide(self._known, self._window([*self._steps[self._count :], now]))
            self._count = len(self._steps)
            return outputs
        return self.model.decide(self._encoded, self._window([*self._steps[first:], now]))[0]

    def _first(self) -> int:
        """Number of the first step in the window of the next decision."""
        return max(0, len(self._steps) + 1 - self.model.window)

    def _now(self, observation: Float32[np.ndarray, "B S"]) -> tuple[np.ndarray, ...]:
        """The step whose action is to be decided; the zeros in place of its action are no input."""
        shape, spec = self._best.shape, self.model.spec
        nothing = np.zeros(shape, np.int64) if spec.discrete else np.zeros((*shape, spec.actions), np.float32)
        return self._to_go, observation, nothing

    def _window(self, steps: list[tuple[np.ndarray, ...]]) -> Segments:
        to_go, states, actions = (np.stack(column, axis=1) for column in zip(*steps, strict=True))
        numbers = np.arange(len(self._steps) + 1 - len(steps), len(self._steps) + 1)
        return self._segments(to_go, states, actions, np.tile(numbers, (len(to_go), 1)))

    def _segments(self, to_go: np.ndarray, states: np.ndarray, actions: np.ndarray, numbers: np.ndarray) -> Segments:
        known = np.minimum(numbers, self.model.spec.horizon - 1)  # an episode may be longer than those of training
        return Segments(to_go, states.astype(np.float32), actions, known, np.ones(to_go.shape, bool))

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Actions,
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        self._steps.append((self._to_go, observation.copy(), action.copy()))
        self._outcomes.append((next_observation.copy(), reward.copy()))
        self._to_go = (self._to_go - reward).astype(np.float32)
        if done:
            _, states, actions = (np.stack(column, axis=1) for column in zip(*self._steps, strict=True))
            self._offer(Columns(states, actions, *(np.stack(column, axis=1) for column in zip(*self._outcomes, strict=True))))
            self._start()

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int64[np.ndarray, "B T"] | Float32[np.ndarray, "B T A"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add one episode, of this or any other policy, from which the prompt may come."""
        self._offer(Columns(*(np.array(column) for column in (observations, actions, next_observations, rewards))))
        self._encoded = None

    def _offer(self, episode: Columns) -> None:
        """Add an episode to the context, and take the prompt from it in the environments where it is the best so far."""
        self._episodes = with_episode(self._episodes, episode, self._config)
        states, actions, _, rewards = episode
        length = min(self.model.prompt, rewards.shape[1])
        steps = best_steps(rewards, length)
        rows = np.arange(len(rewards))[:, None]
        found = self._segments(returns_to_go(rewards)[rows, steps], states[rows, steps], actions[rows, steps], steps)
        total = rewards.sum(axis=1, dtype=np.float64)
        better = (total > self._best) | (self._config.keep == "last")
        self._best[better] = total[better]
        for column, new in zip(self._prompt, found, strict=True):
            column[better] = 0
            column[better, :length] = new[better]


def best_steps(rewards: Float32[np.ndarray, "B T"], length: int) -> Int64[np.ndarray, "B L"]:
    """The numbers of the ``length`` consecutive steps with the largest sum of rewards; the first of several."""
    sums = np.lib.stride_tricks.sliding_window_view(rewards.astype(np.float64), length, axis=1).sum(axis=-1)
    return sums.argmax(axis=1)[:, None] + np.arange(length)


def prompted(
    model: DecisionTransformer, batch: int, context: ContextConfig, deploy: Deployment | None = None
) -> PromptedPolicy:
    """The model deployed in B environments.  Raises ConfigError for another rule than ``paper``."""
    if deploy not in (None, "paper"):
        raise ConfigError(
            f"deploy = {deploy!r}: a decision transformer is deployed by 'paper' "
            "only: its prompt changes between episodes; leave deploy out"
        )
    return PromptedPolicy(model, batch, context)
