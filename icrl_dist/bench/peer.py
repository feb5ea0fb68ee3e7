"""DPT in its official layout, implemented for comparison: the query token first, and no cache.

The input of a GPT-2 is the query (its state, and zeros), then the transitions (s, a, s', r), each embedded
by one linear layer with learned positions.  So one forward pass gives the outputs of one query after every
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
from icrl_dist.rollout.policies import DiscretePolicy
from icrl_dist.types import Spec

LAYERS, HEADS, WIDTH = 4, 1, 32
BATCH, LEARNING_RATE, WEIGHT_DECAY = 64, 1e-3, 1e-4


class _PeerBlock(nn.Module):
    """A GPT-2 block with fused attention."""

    def __init__(self) -> None:
        super().__init__()
        self.norm_attn, self.norm_mlp = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.qkv, self.out = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.mlp_up, self.mlp_down = nn.Linear(WIDTH, 4 * WIDTH), nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, x: Float[Tensor, "B T D"]) -> Float[Tensor, "B T D"]:
        b, t, d = x.shape
        # Split q, k and v and their heads, and move the heads before the tokens for batched attention.
        q, k, v = self.qkv(self.norm_attn(x)).view(b, t, 3, HEADS, d // HEADS).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        # Put the heads of a token side by side again.
        x = x + self.out(attended.transpose(1, 2).flatten(2))
        return cast(Tensor, x + self.mlp_down(F.gelu(self.mlp_up(self.norm_mlp(x)), approximate="tanh")))


class Peer(nn.Module):
    """The model: logits of one query after each prefix of its context."""

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        self.spec = spec
        self.embed = nn.Linear(2 * spec.observation + spec.actions + 1, WIDTH)
        self.position = nn.Embedding(4 * (1 + spec.horizon), WIDTH)
        self.blocks = nn.Sequential(*(_PeerBlock() for _ in range(LAYERS)))
        self.norm, self.head = nn.LayerNorm(WIDTH), nn.Linear(WIDTH, spec.actions)
        for module in self.modules():
            if isinstance(module, (nn.Linear, nn.Embedding)):
                nn.init.normal_(module.weight, std=0.02)
            if isinstance(module, nn.Linear):
                nn.init.zeros_(module.bias)

    def forward(self, context: Transitions, query: Float[Tensor, "B S"]) -> Float[Tensor, "B P A"]:
        """Logits given each of the P = T + 1 prefixes of the context, beginning with the empty one."""
        actions = F.one_hot(context.actions, self.spec.actions).to(query.dtype)
        transitions = torch.cat([context.observations, actions, context.next_observations, context.rewards[..., None]], dim=-1)
        padded = F.pad(query, (0, transitions.shape[-1] - query.shape[-1]))
        tokens = self.embed(torch.cat([padded[:, None], transitions], dim=1))
        logits: Tensor = self.head(self.norm(self.blocks(tokens + self.position.weight[: tokens.shape[1]])))
        return logits


def optimizer(model: Peer) -> torch.optim.AdamW:
    """AdamW with the official learning rate."""
    return torch.optim.AdamW(model.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)


def train_step(
    model: Peer,
    optimizer: torch.optim.Optimizer,
    context: Transitions,
    query: Float[Tensor, "B S"],
    label: Float[Tensor, "B A"],
) -> None:
    """One step on the mean loss over all non-empty prefixes."""
    logits = model(context, query)[:, 1:]
    loss = -(label[:, None] * logits.log_softmax(-1)).sum(-1).mean()
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()


class PeerPolicy(DiscretePolicy):
    """Online deployment as in the official code: the context is the last episode."""

    def __init__(self, model: Peer) -> None:
        self._model = model
        self._context: Transitions | None = None
        self._pending: list[tuple[np.ndarray, ...]] = []

    @torch.inference_mode()
    def probabilities(self, observation: Float32[np.ndarray, "B S"]) -> Float[np.ndarray, "B A"]:
        assert self._context is not None, "append or observe an episode first"
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
        """Replace the context by observations, actions, next observations and rewards, each ``(B, T, ...)``."""
        self._context = Transitions(*map(torch.from_numpy, columns))
