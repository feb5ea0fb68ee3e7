"""T_theta of DPT, ICAG and ICAA: transitions in, a distribution over actions out.

Every transition (s, a, s', r) of the context is one token (appendix B.2); a query state is
one token.  Observations are scaled to [-1, 1] by the spec, so nothing here knows a game.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from icrl_dist.config.sections import ModelConfig
from icrl_dist.models import heads
from icrl_dist.models.gpt import GPT, Cache, Decoder, copied
from icrl_dist.types import Spec


class Transitions(NamedTuple):
    """T transitions of each of B contexts."""

    observations: Float[Tensor, "B T S"]
    actions: Int[Tensor, "B T"] | Float[Tensor, "B T A"]
    next_observations: Float[Tensor, "B T S"]
    rewards: Float[Tensor, "B T"]


class Windows(NamedTuple):
    """R windows of each of B contexts: L states in a row, the action taken at each, and its reward (zeta of eq. 6)."""

    states: Float[Tensor, "B R L S"]
    taken: Int[Tensor, "B R L"] | Float[Tensor, "B R L A"]
    gained: Float[Tensor, "B R L"]


class PretrainedTransformer(nn.Module):
    """T_theta(a | s_query, D) of eq. (1), and with ``model.window`` T_theta(a | s_query, D, zeta) of eq. (6)."""

    low: Tensor
    scale: Tensor
    shift: Tensor

    def __init__(self, spec: Spec, config: ModelConfig) -> None:
        super().__init__()
        self.spec, self.config, self.reads = spec, config, heads.head(spec)
        low, high = torch.tensor(spec.low), torch.tensor(spec.high)
        for name, buffer in (("low", low), ("scale", 2 / (high - low)), ("shift", -(high + low) / (high - low))):
            self.register_buffer(name, buffer, persistent=False)
        features = spec.observation * (1 + 2 * config.fourier)
        self.embed_transition = nn.Linear(2 * features + spec.actions + 1, config.width)
        self.embed_query = nn.Linear(features, config.width)
        if config.window > 1:
            self.embed_taken = nn.Linear(features + spec.actions + 1, config.width)
        self.trunk = GPT(config.layers, config.heads, config.width, config.dropout)
        self.head = nn.Linear(config.width, self.reads.outputs)
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear):
                # Variance 1 / fan-in, for 0.02 is GPT-2's at widths near 1000; what is added to
                # the residual stream, less by depth.
                added = 2 * config.layers if name.endswith((".out", ".feed.2")) else 1
                nn.init.normal_(module.weight, std=(module.in_features * added) ** -0.5)
                nn.init.zeros_(module.bias)

    def features(self, observations: Float[Tensor, "*B S"]) -> Float[Tensor, "*B F"]:
        """Observations scaled to [-1, 1], with ``fourier`` sine and cosine pairs of each."""
        x = torch.addcmul(self.shift, observations, self.scale)
        if not self.config.fourier:
            return x
        waves = [f(0.5 * torch.pi * k * x) for k in range(1, self.config.fourier + 1) for f in (torch.sin, torch.cos)]
        return torch.cat([x, *waves], dim=-1)

    def tokens(self, context: Transitions) -> Float[Tensor, "B T D"]:
        """The embedded tokens of a context, one a transition."""
        token = torch.cat(
            [
                self.features(context.observations),
                self.reads.features(context.actions),
                self.features(context.next_observations),
                context.rewards.unsqueeze(-1),
            ],
            dim=-1,
        )
        embedded: Tensor = self.embed_transition(token)
        return embedded

    def window_tokens(self, of: Windows) -> Float[Tensor, "B R L D"]:
        """The embedded tokens of windows: a state, and what was done in the state before it and gained by it."""
        states = self.features(of.states)
        before = torch.cat([states, self.reads.features(of.taken), of.gained.unsqueeze(-1)], dim=-1)[..., :-1, :]
        tokens: Tensor = self.embed_query(states) + F.pad(self.embed_taken(before), (0, 0, 1, 0))
        return tokens

    def encode(self, context: Transitions) -> Cache:
        """Keys and values of a context."""
        return self.trunk.encode(self.tokens(context))

    def decide(
        self, queries: Float[Tensor, "B Q S"], cache: Cache, prefix: Int[Tensor, "B Q"] | None = None
    ) -> Float[Tensor, "B Q O"]:
        """Outputs of T_theta (``models.heads``) at query states, each given its own prefix of the context.

        ``prefix`` is the number of transitions that a query sees; None shows it all of them.
        """
        seen = None if prefix is None else _seen(prefix, cache)
        logits: Tensor = self.head(self.trunk.query(self.embed_query(self.features(queries)), cache, seen))
        return logits

    def follow(self, of: Windows, cache: Cache, prefix: Int[Tensor, "B R"]) -> Float[Tensor, "B R L O"]:
        """Outputs at every state of windows, given a prefix of the context and what was done before in the window."""
        length = of.states.shape[2]
        seen = _seen(prefix.repeat_interleave(length, dim=1), cache)
        states = self.trunk.query(self.window_tokens(of).flatten(1, 2), cache, seen, length)
        logits: Tensor = self.head(states).unflatten(1, (-1, length))
        return logits

    def forward(
        self, context: Transitions, queries: Float[Tensor, "B Q S"], prefix: Int[Tensor, "B Q"]
    ) -> Float[Tensor, "B Q O"]:
        return self.decide(queries, self.encode(context), prefix)


def _seen(prefix: Int[Tensor, "B Q"], cache: Cache) -> Bool[Tensor, "B Q T"]:
    """Which context tokens each query sees: those of its prefix."""
    return torch.arange(cache[0][0].shape[2], device=prefix.device) < prefix.unsqueeze(-1)


class Deployed:
    """T_theta beside a growing context in each of B environments: one token a decision.

    Make it anew when the model has learned something: weights are copied.
    """

    def __init__(self, model: PretrainedTransformer, batch: int) -> None:
        self._model, self._decoder = model, Decoder(model.trunk, batch)
        self._embed, self._head = copied(model.embed_query), copied(model.head)
        self.state: Float[Tensor, "B D"] | None = None
        """Final states of the trunk at the last decision."""

    @property
    def length(self) -> int:
        """Transitions in each context."""
        return self._decoder.length

    def clear(self) -> None:
        """Forget every context."""
        self._decoder.clear()

    @torch.inference_mode()
    def append(self, transitions: Transitions) -> None:
        """Append transitions to each context."""
        self._decoder.append(self._model.tokens(transitions))

    @torch.inference_mode()
    def follow(self, of: Windows, arrived: Transitions | None = None) -> Float[Tensor, "B O"]:
        """Outputs at the last state of one window a context, given the whole context; one transition may arrive before."""
        joined = None if arrived is None else self._model.tokens(arrived)[:, 0]
        self.state = self._decoder.window(self._model.window_tokens(of)[:, 0], joined)
        return F.linear(self.state, *self._head)

    @torch.inference_mode()
    def decide(self, states: Float[Tensor, "B S"]) -> Float[Tensor, "B O"]:
        """Logits of T_theta at a query state of each context, given the whole of it."""
        self.state = self._decoder.query(F.linear(self._model.features(states), *self._embed))
        return F.linear(self.state, *self._head)

    @torch.inference_mode()
    def peek(self, row: int, states: Float[Tensor, "Q S"], arrived: Transitions) -> Float[Tensor, "Q O"]:
        """Outputs at any query states given the whole context ``row`` and E transitions (of one context) more.

        The same as ``decide`` for each state, and later decisions are as if nobody had asked.
        """
        queries = F.linear(self._model.features(states), *self._embed)
        return F.linear(self._decoder.peek(row, queries, self._model.tokens(arrived)[0]), *self._head)
