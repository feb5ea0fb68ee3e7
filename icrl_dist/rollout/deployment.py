"""T_theta deployed in a batch of environments: by Algorithm 1, or committed (zeta of eq. 6)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig, Deployment, ModelConfig
from icrl_dist.interfaces import Actions, Watch
from icrl_dist.models.dpt import DeployedTransformer, PretrainedTransformer, Transitions, Windows


def default_deployment(model: ModelConfig) -> Deployment:
    """``committed`` for a model that is trained on action windows."""
    return "committed" if model.window > 1 else "paper"


class InContextPolicy:
    """T_theta(. | s, D_on): the context is frozen within an episode and grows at its end.

    Lines 10 to 17 of Algorithm 1.  A context that outgrows ``context.max`` drops its oldest
    whole episodes and is encoded anew, for kept keys have seen what was dropped.
    """

    def __init__(self, model: PretrainedTransformer, batch: int, context: ContextConfig, watch: Watch | None = None) -> None:
        self.model, self.batch, self._config, self._watch = model, batch, context, watch
        self._episodes: list[Transitions] = []
        self._pending: list[tuple[np.ndarray, ...]] = []
        self._deployed = DeployedTransformer(model, batch)

    @property
    def length(self) -> int:
        """Transitions in the context of each environment."""
        return self._deployed.length

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The actions that these uniform numbers in [0, 1) pick: one a row, or one a component."""
        return self.model.action_head.act(self._decide(observation), u)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        """The distribution over discrete actions."""
        return self._decide(observation).softmax(-1).cpu().numpy()

    def distribution(self, states: Float32[np.ndarray, "Q S"], row: int = 0) -> Float[np.ndarray, "Q A"]:
        """T_theta(. | s, D) at any states s, D being the context of environment ``row`` as the next decision sees it.

        Every state stands alone: what the agent did last (zeta) is not told.  Nothing changes: later
        actions are as if nobody had asked.
        """
        (queries,) = self._tensors(states)
        arrived = Transitions(*self._tensors(*(column[None] for column in self._stacked(self._arrived(), row))))
        outputs = self._deployed.decide_row(row, queries, arrived)
        return outputs.softmax(-1).cpu().numpy()

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """D of ``distribution``: observations (T, S), actions (T), next observations (T, S) and rewards (T)."""
        taken_up = zip(*([c[row].cpu().numpy() for c in episode] for episode in self._episodes), strict=True)
        columns = [np.concatenate(column) for column in taken_up] or self._stacked([], row)
        return tuple(np.concatenate(both) for both in zip(columns, self._stacked(self._running(), row), strict=True))

    def _running(self) -> list[tuple[np.ndarray, ...]]:
        """What of the running episode is in the context."""
        return []

    def _arrived(self) -> list[tuple[np.ndarray, ...]]:
        """What of it the decoder has not been told yet."""
        return []

    def _stacked(self, steps: list[tuple[np.ndarray, ...]], row: int) -> list[np.ndarray]:
        spec = self.model.spec
        shapes = ((spec.observation,), () if spec.discrete else (spec.actions,), (spec.observation,), ())
        kinds = (np.float32, np.int64 if spec.discrete else np.float32, np.float32, np.float32)
        columns = ([step[i][row] for step in steps] for i in range(len(kinds)))
        return [np.array(c, kind).reshape(-1, *shape) for c, kind, shape in zip(columns, kinds, shapes, strict=True)]

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
        if self._watch is not None and self._deployed.state is not None:
            self._watch(self._deployed.state.cpu().numpy(), observation, action, reward, next_observation)
            self._deployed.state = None
        self._pending.append((observation, action, next_observation, reward))
        if done:
            self._end(self._episode())

    def _end(self, episode: Transitions) -> None:
        """Take up an episode of one's own."""
        self._add(episode)

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

    zeta is what the agent did last in this episode, as if the optimal policy had done it (eq. 6):
    what T_theta has begun to do it goes on with.  It lets go of a guess by itself when the guess
    proves wrong, because it also trained on windows that wrong guesses led (``pretrain.decoy_fraction``).
    """

    def __init__(self, model: PretrainedTransformer, batch: int, context: ContextConfig, watch: Watch | None = None) -> None:
        super().__init__(model, batch, context, watch)
        self._read = 0  # of self._pending, what is in the context already

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float[torch.Tensor, "B O"]:
        for step in self._pending[self._read : -1]:  # it was not asked for an action since
            self._deployed.append(self._one(step))
        arrived = self._one(self._pending[-1]) if self._read < len(self._pending) else None
        self._read = len(self._pending)
        past = self._pending[1 - self.model.config.window :]
        nothing = np.zeros_like(past[0][1]) if past else self._no_action(len(observation))
        columns = zip(*past, (observation, nothing, observation, np.zeros(len(observation), np.float32)), strict=True)
        states, taken, _, gained = (np.stack(column, axis=1)[:, None] for column in columns)
        return self._deployed.decide_window(Windows(*self._tensors(states, taken, gained)), arrived)

    def _running(self) -> list[tuple[np.ndarray, ...]]:
        return self._pending

    def _arrived(self) -> list[tuple[np.ndarray, ...]]:
        return self._pending[self._read :]

    def _one(self, step: tuple[np.ndarray, ...]) -> Transitions:
        return Transitions(*self._tensors(*(column[:, None] for column in step)))

    def _no_action(self, rows: int) -> Actions:
        spec = self.model.spec
        return np.zeros(rows, np.int64) if spec.discrete else np.zeros((rows, spec.actions), np.float32)

    def _end(self, episode: Transitions) -> None:
        read, self._read = self._read, 0
        if not self._remember(episode):
            self._deployed.append(Transitions(*(column[:, read:] for column in episode)))


def in_context(
    model: PretrainedTransformer,
    batch: int,
    context: ContextConfig,
    deploy: Deployment | None = None,
    watch: Watch | None = None,
) -> InContextPolicy:
    """T_theta deployed by this rule, or by the better one that it was trained for.

    ``watch`` is told of every decision once its outcome is observed.

    Raises ConfigError for ``committed`` if it was not trained on windows.
    """
    rule = deploy or default_deployment(model.config)
    if rule == "committed" and model.config.window == 1:
        raise ConfigError(
            "deploy 'committed': this agent never trained on windows (model.window = 1); "
            "deploy it by 'paper', or train with model.window, pretrain.windows and optim.windows"
        )
    return {"paper": InContextPolicy, "committed": CommittedPolicy}[rule](model, batch, context, watch)
