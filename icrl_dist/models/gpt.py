"""A causal GPT-2 trunk whose keys and values can be kept, grown and queried.

Context tokens come first and see only earlier context tokens; query tokens come after, and
each sees its own prefix of the context and itself.  So one encoding of a context serves
many queries in training, and a decision costs one token in deployment.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

Cache = list[tuple[Tensor, Tensor]]
"""Keys and values ``(B, heads, T, width / heads)`` of every layer."""


class Block(nn.Module):
    """One pre-norm transformer layer: attention, then a feed-forward net four times as wide."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm_feed = nn.LayerNorm(width)
        self.feed = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.drop = nn.Dropout(dropout)

    def project(self, x: Float[Tensor, "B T D"]) -> tuple[Tensor, Tensor, Tensor]:
        """Query, key and value of each token, split by head: ``(B, heads, T, D / heads)``."""
        b, t, d = x.shape
        qkv = self.qkv(self.norm_attention(x)).view(b, t, 3, self.heads, d // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        return q, k, v

    def finish(self, x: Float[Tensor, "B T D"], attended: Float[Tensor, "B N T d"]) -> Float[Tensor, "B T D"]:
        """The residual stream after attention has been computed."""
        x = x + self.drop(self.out(attended.transpose(1, 2).flatten(2)))
        return x + self.drop(self.feed(self.norm_feed(x)))


class GPT(nn.Module):
    """``layers`` blocks over embedded tokens; no position embedding: a context is a set."""

    def __init__(self, layers: int, heads: int, width: int, dropout: float) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def encode(self, x: Float[Tensor, "B T D"], past: Cache | None = None) -> Cache:
        """Keys and values of context tokens x, appended to those of an earlier context.

        A token sees the whole past and itself and its predecessors in x.
        """
        cache: Cache = []
        for index, block in enumerate(self.blocks):
            assert isinstance(block, Block)
            q, k, v = block.project(x)
            if past is None:
                attended = F.scaled_dot_product_attention(q, k, v, is_causal=True)
            else:
                k, v = torch.cat([past[index][0], k], dim=2), torch.cat([past[index][1], v], dim=2)
                new, total = q.shape[2], k.shape[2]
                seen = torch.ones(new, total, dtype=torch.bool, device=x.device).tril(total - new)
                attended = F.scaled_dot_product_attention(q, k, v, attn_mask=seen)
            cache.append((k, v))
            if index + 1 < len(self.blocks):
                x = block.finish(x, attended)
        return cache

    def query(
        self, x: Float[Tensor, "B Q D"], cache: Cache, seen: Bool[Tensor, "B #Q T"] | None = None
    ) -> Float[Tensor, "B Q D"]:
        """Final states of query tokens x, each seeing the context tokens ``seen`` and itself.

        ``seen=None`` shows every query the whole context.
        """
        for block, (keys, values) in zip(self.blocks, cache, strict=True):
            assert isinstance(block, Block)
            q, k, v = block.project(x)
            scale = q.shape[-1] ** -0.5
            to_context = (q @ keys.transpose(2, 3)) * scale
            if seen is not None:
                to_context = to_context.masked_fill(~seen[:, None], float("-inf"))
            to_self = (q * k).sum(-1, keepdim=True) * scale
            weight = torch.cat([to_context, to_self], dim=-1).softmax(dim=-1)
            x = block.finish(x, weight[..., :-1] @ values + weight[..., -1:] * v)
        result: Tensor = self.norm(x)
        return result
