"""DPT in its official layout, written anew to compare with: query first, and no token kept.

A GPT-2 reads the query (its state; zeros elsewhere), then the transitions (s, a, s', r), each
through one linear map, with learned positions.  So one pass answers one query, after every
prefix of the context, and in deployment each decision encodes the whole context again.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor, nn
from torch.nn import functional as F

from icrl_dist.models.dpt import Transitions
from icrl_dist.types import Spec

LAYERS, HEADS, WIDTH = 4, 1, 32
BATCH, LEARNING_RATE, WEIGHT_DECAY = 64, 1e-3, 1e-4


class _Block(nn.Module):
    """GPT-2's, with attention in one fused call."""

    def __init__(self) -> None:
        super().__init__()
        self.norm_attention, self.norm_feed = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.qkv, self.out = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.widen, self.narrow = nn.Linear(WIDTH, 4 * WIDTH), nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, x: Float[Tensor, "B T D"]) -> Float[Tensor, "B T D"]:
        b, t, d = x.shape
        q, k, v = self.qkv(self.norm_attention(x)).view(b, t, 3, HEADS, d // HEADS).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        x = x + self.out(attended.transpose(1, 2).flatten(2))
        return cast(Tensor, x + self.narrow(F.gelu(self.widen(self.norm_feed(x)), approximate="tanh")))


class Peer(nn.Module):
    """The model: logits after each prefix of a context, for the one query before it."""

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        self.spec = spec
        self.embed = nn.Linear(2 * spec.observation + spec.actions + 1, WIDTH)
        self.place = nn.Embedding(4 * (1 + spec.horizon), WIDTH)
        self.blocks = nn.Sequential(*(_Block() for _ in range(LAYERS)))
        self.norm, self.head = nn.LayerNorm(WIDTH), nn.Linear(WIDTH, spec.actions)
        for module in self.modules():
            if isinstance(module, (nn.Linear, nn.Embedding)):
                nn.init.normal_(module.weight, std=0.02)
            if isinstance(module, nn.Linear):
                nn.init.zeros_(module.bias)

    def forward(self, context: Transitions, query: Float[Tensor, "B S"]) -> Float[Tensor, "B P A"]:
        """Logits given each of the P = T + 1 prefixes of the context, the empty one first."""
        actions = F.one_hot(context.actions, self.spec.actions).to(query.dtype)
        seen = torch.cat([context.observations, actions, context.next_observations, context.rewards[..., None]], dim=-1)
        asked = F.pad(query, (0, seen.shape[-1] - query.shape[-1]))
        tokens = self.embed(torch.cat([asked[:, None], seen], dim=1))
        logits: Tensor = self.head(self.norm(self.blocks(tokens + self.place.weight[: tokens.shape[1]])))
        return logits


def optimizer(model: Peer) -> torch.optim.AdamW:
    """AdamW at the official rate."""
    return torch.optim.AdamW(model.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)


def train_step(
    model: Peer, opt: torch.optim.Optimizer, context: Transitions, query: Float[Tensor, "B S"], label: Float[Tensor, "B A"]
) -> None:
    """One step on the mean loss over all prefixes but the empty one."""
    logits = model(context, query)[:, 1:]
    value = -(label[:, None] * logits.log_softmax(-1)).sum(-1).mean()
    opt.zero_grad(set_to_none=True)
    value.backward()
    opt.step()


class PeerPolicy:
    """Online deployment as the official code has it: the context is the newest episode."""

    def __init__(self, model: Peer) -> None:
        self._model = model
        self._context: Transitions | None = None
        self._pending: list[tuple[np.ndarray, ...]] = []

    @torch.inference_mode()
    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        assert self._context is not None, "let it observe an episode first"
        logits = self._model(self._context, torch.from_numpy(np.array(observation)))
        return cast(Tensor, logits[:, -1].softmax(-1)).numpy()

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
            self.append(*(np.stack(column, axis=1) for column in zip(*self._pending, strict=True)))
            self._pending = []

    def append(self, *columns: np.ndarray) -> None:
        """Replace the context by observations, actions, next observations and rewards, ``(B, T, ...)`` each."""
        self._context = Transitions(*map(torch.from_numpy, columns))
