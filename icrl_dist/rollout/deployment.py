"""T_theta deployed in a batch of environments: by Algorithm 1, by a growing context, or with action windows (eq. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int64

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig, Decoder, Deployment, ModelConfig
from icrl_dist.config.toml import nearest
from icrl_dist.copies import CopiedWhole
from icrl_dist.interfaces import Actions, Watch
from icrl_dist.models.deployed import Columns, Deployed, WindowColumns
from icrl_dist.models.kernel import decoder_here, require_kernel
from icrl_dist.models.kernel_transformer import KernelTransformer
from icrl_dist.models.stored import StoredTransformer

if TYPE_CHECKING:
    from icrl_dist.models.dpt import PretrainedTransformer


def default_deployment(model: ModelConfig) -> Deployment:
    """``committed`` for a model that is trained on action windows, else ``paper``."""
    return "committed" if model.window > 1 else "paper"


def with_episode(episodes: Sequence[Columns], episode: Columns, config: ContextConfig) -> list[Columns]:
    """The episodes of a context after one more: without the oldest beyond ``context.max``, or with ``keep = "last"`` alone."""
    kept = [] if config.keep == "last" else list(episodes)
    total = sum(e.actions.shape[1] for e in kept) + episode.actions.shape[1]
    while kept and total > config.max:
        total -= kept.pop(0).actions.shape[1]
    return [*kept, episode]


class InContextPolicy(CopiedWhole):
    """T_theta(. | s, D_on): the context is frozen within an episode and grows at its end.

    Lines 10 to 17 of Algorithm 1.  A context longer than ``context.max`` drops its oldest episodes and
    is encoded again, because the cached keys of later transitions depend on the dropped ones.
    """

    def __init__(
        self,
        model: PretrainedTransformer | StoredTransformer,
        batch: int,
        context: ContextConfig,
        watch: Watch | None = None,
    ) -> None:
        self.model, self.batch, self._config, self._watch = model, batch, context, watch
        self._episodes: list[Columns] = []
        self._pending: list[tuple[np.ndarray, ...]] = []
        self._deployed = deployed(model, batch, context.decoder)

    @property
    def length(self) -> int:
        """Transitions in the context of each environment."""
        return self._deployed.length

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The actions that the uniform numbers in [0, 1) select: one number per row, or one per component."""
        return self._deployed.act(self._decide(observation), u)

    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        """The distribution over discrete actions."""
        return self._deployed.probabilities(self._decide(observation))

    def distribution(self, states: Float32[np.ndarray, "Q S"], row: int = 0) -> Float[np.ndarray, "Q A"]:
        """T_theta(. | s, D) at any states s, with the context D that environment ``row`` will have at its next decision.

        The action window (zeta) is not an input, so each state is a query of its own.  The policy does not
        change: later actions are the same with and without this call.
        """
        new = Columns(*(column[None] for column in self._stacked(self._not_encoded(), row)))
        return self._deployed.probabilities(self._deployed.decide_row(row, states, new))

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> Float[np.ndarray, "B Q A"] | None:
        """T_theta(. | s, D) at any states s for the whole next episode, whose context D is fixed; None for vector actions."""
        if not self.model.spec.discrete:
            return None
        return np.stack([self.distribution(states, row) for row in range(self.batch)])

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """D of ``distribution``: observations (T, S), actions (T), next observations (T, S) and rewards (T)."""
        ended = zip(*([c[row] for c in episode] for episode in self._episodes), strict=True)
        columns = [np.concatenate(column) for column in ended] or self._stacked([], row)
        return tuple(np.concatenate(both) for both in zip(columns, self._stacked(self._running(), row), strict=True))

    def _running(self) -> list[tuple[np.ndarray, ...]]:
        """The transitions of the running episode that belong to the context."""
        return []

    def _not_encoded(self) -> list[tuple[np.ndarray, ...]]:
        """Those of them that the decoder has not encoded yet."""
        return []

    def _stacked(self, steps: list[tuple[np.ndarray, ...]], row: int) -> list[np.ndarray]:
        spec = self.model.spec
        shapes = ((spec.observation,), () if spec.discrete else (spec.actions,), (spec.observation,), ())
        kinds = (np.float32, np.int64 if spec.discrete else np.float32, np.float32, np.float32)
        columns = ([step[i][row] for step in steps] for i in range(len(kinds)))
        return [np.array(c, kind).reshape(-1, *shape) for c, kind, shape in zip(columns, kinds, shapes, strict=True)]

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B O"]:
        return self._deployed.decide(observation)

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Actions,
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        if self._watch is not None and self._deployed.state is not None:
            self._watch(self._deployed.state, observation, action, reward, next_observation)
            self._deployed.state = None
        self._pending.append(tuple(np.array(column) for column in (observation, action, next_observation, reward)))
        if done:
            self._add_own(self._ended_episode())

    def _add_own(self, episode: Columns) -> None:
        """Add an episode of this policy to the context."""
        self._add(episode)

    def _ended_episode(self) -> Columns:
        """The episode that has just ended."""
        columns = [np.stack(column, axis=1) for column in zip(*self._pending, strict=True)]
        self._pending = []
        return Columns(*columns)

    def append(
        self,
        observations: Float32[np.ndarray, "B T S"],
        actions: Int64[np.ndarray, "B T"] | Float32[np.ndarray, "B T A"],
        next_observations: Float32[np.ndarray, "B T S"],
        rewards: Float32[np.ndarray, "B T"],
    ) -> None:
        """Add one episode, of this or any other policy, to the context."""
        self._add(Columns(*(np.array(column) for column in (observations, actions, next_observations, rewards))))

    def _add(self, episode: Columns) -> None:
        if not self._add_to_context(episode):
            self._deployed.append(episode)

    def _add_to_context(self, episode: Columns) -> bool:
        """Add an episode to the context; True if older ones were dropped and the whole context was encoded again."""
        kept = with_episode(self._episodes, episode, self._config)
        dropped, self._episodes = len(kept) <= len(self._episodes), kept
        if dropped:
            self._encode_again()
        return dropped

    def _encode_again(self) -> None:
        """Encode the ended episodes of the context, and nothing else."""
        self._deployed.clear()
        self._deployed.append(Columns(*(np.concatenate(columns, axis=1) for columns in zip(*self._episodes, strict=True))))


class GrowingPolicy(InContextPolicy):
    """T_theta(. | s, D_on): every transition joins the context at once, as Algorithm Distillation deploys its model.

    Episodes beyond ``context.max`` are dropped at the end of an episode, so that within an episode a context is up to one
    episode longer.
    """

    _encoded = 0
    """Number of the transitions in ``_pending`` that the decoder has encoded."""

    def frozen(self, states: Float32[np.ndarray, "Q S"]) -> None:
        """None: the context grows within an episode."""

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B O"]:
        self._encode(len(self._pending))
        return self._deployed.decide(observation)

    def _encode(self, count: int) -> None:
        """Add the first ``count`` transitions of the running episode to the decoder's context."""
        for step in self._pending[self._encoded : count]:
            self._deployed.append(self._one(step))
        self._encoded = max(self._encoded, count)

    def _running(self) -> list[tuple[np.ndarray, ...]]:
        return self._pending

    def _not_encoded(self) -> list[tuple[np.ndarray, ...]]:
        return self._pending[self._encoded :]

    def _one(self, step: tuple[np.ndarray, ...]) -> Columns:
        return Columns(*(column[:, None] for column in step))

    def _add(self, episode: Columns) -> None:
        """In mid-episode the running episode is encoded again, because it comes after the ended ones."""
        super()._add(episode)
        if self._encoded:
            self._encode_again()
            self._encoded = 0

    def _add_own(self, episode: Columns) -> None:
        encoded, self._encoded = self._encoded, 0
        if not self._add_to_context(episode):
            self._deployed.append(Columns(*(column[:, encoded:] for column in episode)))


class CommittedPolicy(GrowingPolicy):
    """T_theta(. | s, D_on, zeta): the context grows at once, and the agent's own action window is an input.

    zeta holds the agent's last transitions in this episode, as if the optimal policy had acted (eq. 6).
    Therefore T_theta continues to act on the same hypothesis of the task.  It gives up a wrong hypothesis,
    because some training windows hold actions of another task's policy (``pretrain.decoy_fraction``).
    """

    def _decide(self, observation: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B O"]:
        self._encode(len(self._pending) - 1)  # observed since the last decision; the newest follows below
        newest = self._one(self._pending[-1]) if self._encoded < len(self._pending) else None
        self._encoded = len(self._pending)
        past = self._pending[1 - self.model.config.window :]
        nothing = np.zeros_like(past[0][1]) if past else self._no_action(len(observation))
        columns = zip(*past, (observation, nothing, observation, np.zeros(len(observation), np.float32)), strict=True)
        states, actions, _, rewards = (np.stack(column, axis=1) for column in columns)
        return self._deployed.decide_window(WindowColumns(states, actions, rewards), newest)

    def _no_action(self, rows: int) -> Actions:
        spec = self.model.spec
        return np.zeros(rows, np.int64) if spec.discrete else np.zeros((rows, spec.actions), np.float32)


def deployed(model: PretrainedTransformer | StoredTransformer, batch: int, decoder: Decoder = "auto") -> Deployed:
    """The transformer deployed in B environments by this decoder (``config.ContextConfig``).

    A model on a GPU, or where there is no kernel, is always deployed by torch, a stored one always by the kernel; then
    this raises ConfigError where there is none.
    """
    if isinstance(model, StoredTransformer):
        weights = model.weights
    else:
        from icrl_dist.models.dpt import DeployedTransformer
        from icrl_dist.models.weights import weights_of

        if decoder_here(decoder, model.config) == "torch" or model.low.device.type != "cpu":
            return DeployedTransformer(model, batch)
        weights = weights_of(model)
    require_kernel()
    return KernelTransformer(model.spec, model.config, weights, batch)


_RULES: dict[Deployment, type[InContextPolicy]] = {
    "paper": InContextPolicy,
    "committed": CommittedPolicy,
    "growing": GrowingPolicy,
}


def in_context(
    model: PretrainedTransformer | StoredTransformer,
    batch: int,
    context: ContextConfig,
    deploy: Deployment | None = None,
    watch: Watch | None = None,
) -> InContextPolicy:
    """T_theta deployed by this rule; None: the rule of ``default_deployment``.

    ``watch`` is called after every decision with the decision and its outcome.

    Raises ConfigError for an unknown rule, and for ``committed`` if the model was not trained on action windows.
    """
    rule = default_deployment(model.config) if deploy is None else deploy
    if rule not in _RULES:
        raise ConfigError(f"deploy = {rule!r}{nearest(str(rule), tuple(_RULES))}: choose {' or '.join(_RULES)}")
    if rule == "committed" and model.config.window == 1:
        raise ConfigError(
            "deploy 'committed': this agent was not trained on action windows (model.window = 1); "
            "deploy it by 'paper', or train with model.window, pretrain.windows and optim.windows"
        )
    return _RULES[rule](model, batch, context, watch)
