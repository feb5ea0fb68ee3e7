"""T_theta of DPT, ICAG and ICAA: a context of transitions in, a distribution over actions out.

Every transition (s, a, s', r) of the context is one token (appendix B.2); a query state is one
token.  Observations are scaled to [-1, 1] by the spec, so the model depends on no environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor, nn
from torch.nn import functional as F

from icrl_dist.config.sections import ModelConfig
from icrl_dist.interfaces import Actions
from icrl_dist.models import heads
from icrl_dist.models.decoder import Decoder, weight_and_bias
from icrl_dist.models.deployed import Columns, WindowColumns
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
        for linear, over_variance in self._linear_layers():
            nn.init.normal_(linear.weight, std=over_variance**-0.5)
            nn.init.zeros_(linear.bias)

    def _linear_layers(self) -> Iterator[tuple[nn.Linear, int]]:
        """The linear layers, each with 1 over the variance of its initial weights."""
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear):
                # Variance 1 / fan-in: GPT-2's 0.02 suits widths near 1000.  Layers that add to the
                # residual stream are smaller by the square root of their number, as in GPT-2.
                residual = 2 * self.config.layers if name.endswith((".out", ".feed.2")) else 1
                yield module, module.in_features * residual

    @torch.no_grad()
    def draw_weights(self, rng: np.random.Generator) -> None:
        """Draw new initial weights by numpy: those that torch draws depend on the processor's vector instructions."""
        for linear, over_variance in self._linear_layers():
            drawn = rng.standard_normal(linear.weight.shape) / math.sqrt(over_variance)
            linear.weight.copy_(torch.from_numpy(drawn.astype(np.float32)))

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
    """``models.deployed.Deployed`` by torch, on the device of the model."""

    def __init__(self, model: PretrainedTransformer, batch: int) -> None:
        self._model, self._decoder = model, Decoder(model.trunk, batch)
        self._embed, self._head = weight_and_bias(model.embed_query), weight_and_bias(model.head)
        self.state: Float32[np.ndarray, "B D"] | None = None

    @property
    def length(self) -> int:
        return self._decoder.length

    def clear(self) -> None:
        self._decoder.clear()

    @torch.inference_mode()
    def append(self, transitions: Columns) -> None:
        self._decoder.append(self._tokens(transitions))

    @torch.inference_mode()
    def decide(self, states: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B O"]:
        return self._outputs(self._decoder.query(self._queries(states)))

    @torch.inference_mode()
    def decide_window(self, windows: WindowColumns, arrived: Columns | None = None) -> Float32[np.ndarray, "B O"]:
        token = None if arrived is None else self._tokens(arrived)[:, 0]
        # The model takes several windows per context, (B, R, L): here R is 1.
        tokens = self._model.window_tokens(Windows(*(column[:, None] for column in self._tensors(*windows))))[:, 0]
        return self._outputs(self._decoder.window(tokens, token))

    @torch.inference_mode()
    def decide_row(self, row: int, states: Float32[np.ndarray, "Q S"], appended: Columns) -> Float32[np.ndarray, "Q O"]:
        found = self._decoder.query_row(row, self._queries(states), self._tokens(appended)[0])
        outputs: np.ndarray = F.linear(found, *self._head).cpu().numpy()
        return outputs

    def act(self, outputs: Float32[np.ndarray, "B O"], u: Float[np.ndarray, "B U"]) -> Actions:
        return self._model.action_head.act(torch.from_numpy(outputs), u)

    def probabilities(self, outputs: Float32[np.ndarray, "B O"]) -> Float32[np.ndarray, "B A"]:
        found: np.ndarray = torch.from_numpy(outputs).softmax(-1).numpy()
        return found

    def _queries(self, states: Float32[np.ndarray, "Q S"]) -> Float[Tensor, "Q D"]:
        return F.linear(self._model.features(*self._tensors(states)), *self._embed)

    def _tokens(self, transitions: Columns) -> Float[Tensor, "B T D"]:
        return self._model.tokens(Transitions(*self._tensors(*transitions)))

    def _outputs(self, state: Float[Tensor, "B D"]) -> Float32[np.ndarray, "B O"]:
        self.state = state.cpu().numpy()
        outputs: np.ndarray = F.linear(state, *self._head).cpu().numpy()
        return outputs

    def _tensors(self, *columns: np.ndarray) -> Iterator[Tensor]:
        return (torch.from_numpy(np.array(column)).to(self._model.low.device) for column in columns)
