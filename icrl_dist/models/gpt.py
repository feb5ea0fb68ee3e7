"""A causal GPT-2 trunk for training.  ``models.decoder`` runs the same weights in deployment.

Context tokens come first, and each sees only the context tokens before it and itself.  Query tokens
come after; each sees its own prefix of the context, the tokens before it in its window, and itself.
So one encoding of a context serves many queries in training, and a decision in deployment costs one
token, or as many tokens as its window is long.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

KVCache = list[tuple[Tensor, Tensor]]
"""Keys and values ``(B, heads, T, width / heads)`` of every layer."""


class Block(nn.Module):
    """One pre-norm transformer layer: attention, then an MLP four times as wide."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm_feed = nn.LayerNorm(width)
        self.feed = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.drop = nn.Dropout(dropout)

    def attn_qkv(self, x: Float[Tensor, "B T D"]) -> tuple[Tensor, Tensor, Tensor]:
        """Query, key and value of each token, split by head: ``(B, heads, T, D / heads)``."""
        b, t, d = x.shape
        # One product makes q, k and v; split its output into (q | k | v) and heads, and move the heads
        # before the tokens, so that attention is a batched product over (B, heads).
        qkv = self.qkv(self.norm_attention(x)).view(b, t, 3, self.heads, d // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        return q, k, v

    def attn_kv(self, x: Float[Tensor, "B T D"]) -> tuple[Tensor, Tensor]:
        """Key and value of each token, as in ``attn_qkv``; the last layer needs no queries of the context."""
        b, t, d = x.shape
        # The first d rows of the weight make q and are skipped; the reshape is that of attn_qkv.
        kv = F.linear(self.norm_attention(x), self.qkv.weight[d:], self.qkv.bias[d:]).view(b, t, 2, self.heads, d // self.heads)
        k, v = kv.permute(2, 0, 3, 1, 4)
        return k, v

    def attn_out_and_mlp(self, x: Float[Tensor, "B T D"], attended: Float[Tensor, "B N T d"]) -> Float[Tensor, "B T D"]:
        """Add attention's output and then the MLP's to the residual stream ``x``."""
        # (B, heads, T, d) -> (B, T, heads * d): put the heads of a token side by side again.
        x = x + self.drop(self.out(attended.transpose(1, 2).flatten(2)))
        return x + self.drop(self.feed(self.norm_feed(x)))


class GPT(nn.Module):
    """``layers`` blocks over embedded tokens.  No position embedding: a context is a set of transitions."""

    def __init__(self, layers: int, heads: int, width: int, dropout: float) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def encode(self, x: Float[Tensor, "B T D"]) -> KVCache:
        """Keys and values of context tokens ``x``; each token sees itself and those before it."""
        cache: KVCache = []
        for block in self.blocks:
            assert isinstance(block, Block)
            if len(cache) + 1 == len(self.blocks):
                cache.append(block.attn_kv(x))
            else:
                q, k, v = block.attn_qkv(x)
                cache.append((k, v))
                x = block.attn_out_and_mlp(x, F.scaled_dot_product_attention(q, k, v, is_causal=True))
        return cache

    def query(
        self, x: Float[Tensor, "B Q D"], cache: KVCache, visible: Bool[Tensor, "B #Q T"] | None = None, window: int = 1
    ) -> Float[Tensor, "B Q D"]:
        """Final states of query tokens ``x``; each sees the ``visible`` context tokens and itself.

        With ``visible=None`` every query sees the whole context.  Each group of ``window`` tokens in a
        row is a window; a token also sees the tokens before it in its window.
        """
        for block, (keys, values) in zip(self.blocks, cache, strict=True):
            assert isinstance(block, Block)
            q, k, v = block.attn_qkv(x)
            scale = q.shape[-1] ** -0.5
            context_scores = (q @ keys.transpose(2, 3)) * scale
            if visible is not None:
                # (B, Q, T) -> (B, 1, Q, T): the same mask for every head.
                context_scores = context_scores.masked_fill(~visible[:, None], float("-inf"))
            # One softmax over context and window together.
            weights = torch.cat([context_scores, _window_scores(q, k, window) * scale], dim=-1).softmax(dim=-1)
            on_context, on_window = weights[..., :-window], weights[..., -window:]
            if window == 1:
                mixed = on_window * v
            else:
                # Mix within each window, then join windows and tokens into one axis again.
                mixed = (_split_windows(on_window, window) @ _split_windows(v, window)).flatten(2, 3)
            x = block.attn_out_and_mlp(x, on_context @ values + mixed)
        result: Tensor = self.norm(x)
        return result


def causal_mask(length: int, device: torch.device) -> Bool[Tensor, "L L"]:
    """True where the token of a row may see the token of a column: itself and those before it."""
    return torch.ones(length, length, dtype=torch.bool, device=device).tril()


def _split_windows(x: Float[Tensor, "B N Q d"], window: int) -> Float[Tensor, "B N R L d"]:
    """Split the token axis into R windows of L tokens, so that products stay within a window."""
    return x.reshape(*x.shape[:2], -1, window, x.shape[3])


def _window_scores(q: Float[Tensor, "B N Q d"], k: Float[Tensor, "B N Q d"], window: int) -> Float[Tensor, "B N Q L"]:
    """Scores of each query against the tokens of its own window; -inf for the tokens after it."""
    if window == 1:
        return (q * k).sum(-1, keepdim=True)
    scores = _split_windows(q, window) @ _split_windows(k, window).transpose(3, 4)
    # (B, N, R, L, L) -> (B, N, Q, L): one row of scores per query again.
    return scores.masked_fill(~causal_mask(window, q.device), float("-inf")).flatten(2, 3)
