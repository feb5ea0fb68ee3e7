"""T_theta of DPT, ICAG and ICAA: a context of transitions in, a distribution over actions out.

Every transition (s, a, s', r) of the context is one token (appendix B.2); a query state is one
token.  Observations are scaled to [-1, 1] by the spec, so the model depends on no environment.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from icrl_dist.config.sections import ModelConfig
from icrl_dist.models import heads
from icrl_dist.models.decoder import Decoder, weight_and_bias
from icrl_dist.models.gpt import GPT, KVCache
from icrl_dist.types import Spec


class Transitions(NamedTuple):
    """T transitions of each of B contexts."""

    observations: Float[Tensor, "B T S"]
    actions: Int[Tensor, "B T"] | Float[Tensor, "B T A"]
    next_observations: Float[Tensor, "B T S"]
    rewards: Float[Tensor, "B T"]


class Windows(NamedTuple):
    """R action windows of each of B contexts (zeta_h of eq. 6): L consecutive states, and the action and reward at each."""

    states: Float[Tensor, "B R L S"]
    prev_actions: Int[Tensor, "B R L"] | Float[Tensor, "B R L A"]
    prev_rewards: Float[Tensor, "B R L"]


class PretrainedTransformer(nn.Module):
    """T_theta(a | s_query, D) of eq. (1), and with ``model.window`` T_theta(a | s_query, D, zeta) of eq. (6)."""

    low: Tensor
    scale: Tensor
    shift: Tensor

    def __init__(self, spec: Spec, config: ModelConfig) -> None:
        super().__init__()
        self.spec, self.config, self.action_head = spec, config, heads.action_head(spec)
        low, high = torch.tensor(spec.low), torch.tensor(spec.high)
        for name, buffer in (("low", low), ("scale", 2 / (high - low)), ("shift", -(high + low) / (high - low))):
            self.register_buffer(name, buffer, persistent=False)
        features = spec.observation * (1 + 2 * config.fourier)
        self.embed_transition = nn.Linear(2 * features + spec.actions + 1, config.width)
        self.embed_query = nn.Linear(features, config.width)
        if config.window > 1:
            self.embed_taken = nn.Linear(features + spec.actions + 1, config.width)  # the name is part of every weights digest
        self.trunk = GPT(config.layers, config.heads, config.width, config.dropout)
        self.head = nn.Linear(config.width, self.action_head.outputs)
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear):
                # Variance 1 / fan-in: GPT-2's 0.02 suits widths near 1000.  Layers that add to the
                # residual stream are smaller by the square root of their number, as in GPT-2.
                residual = 2 * config.layers if name.endswith((".out", ".feed.2")) else 1
                nn.init.normal_(module.weight, std=(module.in_features * residual) ** -0.5)
                nn.init.zeros_(module.bias)

    def features(self, observations: Float[Tensor, "*B S"]) -> Float[Tensor, "*B F"]:
        """Observations scaled to [-1, 1], with ``fourier`` sine and cosine pairs of each component."""
        x = torch.addcmul(self.shift, observations, self.scale)
        if not self.config.fourier:
            return x
        waves = [f(0.5 * torch.pi * k * x) for k in range(1, self.config.fourier + 1) for f in (torch.sin, torch.cos)]
        return torch.cat([x, *waves], dim=-1)

    def tokens(self, context: Transitions) -> Float[Tensor, "B T D"]:
        """The embedded tokens of a context, one per transition."""
        token = torch.cat(
            [
                self.features(context.observations),
                self.action_head.features(context.actions),
                self.features(context.next_observations),
                context.rewards.unsqueeze(-1),
            ],
            dim=-1,
        )
        embedded: Tensor = self.embed_transition(token)
        return embedded

    def window_tokens(self, windows: Windows) -> Float[Tensor, "B R L D"]:
        """The embedded tokens of windows: each state, plus the previous state of the window with its action and reward."""
        states = self.features(windows.states)
        actions = self.action_head.features(windows.prev_actions)
        # Without the last step: its action is the one to predict.
        previous = torch.cat([states, actions, windows.prev_rewards.unsqueeze(-1)], dim=-1)[..., :-1, :]
        # Shift by one position: the first state of a window has no previous one, and gets zeros.
        tokens: Tensor = self.embed_query(states) + F.pad(self.embed_taken(previous), (0, 0, 1, 0))
        return tokens

    def encode(self, context: Transitions) -> KVCache:
        """Keys and values of a context."""
        return self.trunk.encode(self.tokens(context))

    def decide(
        self, queries: Float[Tensor, "B Q S"], cache: KVCache, prefix: Int[Tensor, "B Q"] | None = None
    ) -> Float[Tensor, "B Q O"]:
        """Outputs of T_theta (``models.heads``) at query states, each given its own prefix of the context.

        ``prefix`` is the number of transitions that each query sees; None: all of them.
        """
        visible = None if prefix is None else _prefix_mask(prefix, cache)
        outputs: Tensor = self.head(self.trunk.query(self.embed_query(self.features(queries)), cache, visible))
        return outputs

    def decide_windows(self, windows: Windows, cache: KVCache, prefix: Int[Tensor, "B R"]) -> Float[Tensor, "B R L O"]:
        """Outputs at every state of the windows, given a prefix of the context and the earlier steps of the window."""
        length = windows.states.shape[2]
        visible = _prefix_mask(prefix.repeat_interleave(length, dim=1), cache)
        # The trunk takes one axis of tokens, (B, R * L); its argument ``length`` keeps the windows apart.
        states = self.trunk.query(self.window_tokens(windows).flatten(1, 2), cache, visible, length)
        outputs: Tensor = self.head(states).unflatten(1, (-1, length))
        return outputs

    def forward(
        self, context: Transitions, queries: Float[Tensor, "B Q S"], prefix: Int[Tensor, "B Q"]
    ) -> Float[Tensor, "B Q O"]:
        return self.decide(queries, self.encode(context), prefix)


def _prefix_mask(prefix: Int[Tensor, "B Q"], cache: KVCache) -> Bool[Tensor, "B Q T"]:
    """True at the context tokens that each query sees: the first ``prefix`` ones."""
    return torch.arange(cache[0][0].shape[2], device=prefix.device) < prefix.unsqueeze(-1)


class DeployedTransformer:
    """T_theta with one growing context per environment (B of them): a decision costs one token.

    Weights are copied: after more training of the model, make a new one.
    """

    def __init__(self, model: PretrainedTransformer, batch: int) -> None:
        self._model, self._decoder = model, Decoder(model.trunk, batch)
        self._embed, self._head = weight_and_bias(model.embed_query), weight_and_bias(model.head)
        self.state: Float[Tensor, "B D"] | None = None
        """Final states of the trunk at the last decision; None before the first."""

    @property
    def length(self) -> int:
        """Transitions in each context."""
        return self._decoder.length

    def clear(self) -> None:
        """Empty every context."""
        self._decoder.clear()

    @torch.inference_mode()
    def append(self, transitions: Transitions) -> None:
        """Append transitions to each context."""
        self._decoder.append(self._model.tokens(transitions))

    @torch.inference_mode()
    def decide(self, states: Float[Tensor, "B S"]) -> Float[Tensor, "B O"]:
        """Outputs of T_theta at one query state per context, given the whole context."""
        self.state = self._decoder.query(F.linear(self._model.features(states), *self._embed))
        return F.linear(self.state, *self._head)

    @torch.inference_mode()
    def decide_window(self, windows: Windows, arrived: Transitions | None = None) -> Float[Tensor, "B O"]:
        """Outputs at the last state of one window per context, given the whole context.

        One transition per context may join the context first (``arrived``).
        """
        token = None if arrived is None else self._model.tokens(arrived)[:, 0]
        self.state = self._decoder.window(self._model.window_tokens(windows)[:, 0], token)
        return F.linear(self.state, *self._head)

    @torch.inference_mode()
    def decide_row(self, row: int, states: Float[Tensor, "Q S"], appended: Transitions) -> Float[Tensor, "Q O"]:
        """Outputs at Q query states, given the whole context ``row`` and E more transitions (of this context).

        Equal to ``decide`` for each state.  Nothing changes: later decisions are as without this call.
        """
        queries = F.linear(self._model.features(states), *self._embed)
        return F.linear(self._decoder.query_row(row, queries, self._model.tokens(appended)[0]), *self._head)
