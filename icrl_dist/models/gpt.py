"""A causal GPT-2 trunk in two forms: ``GPT`` to train, ``Decoder`` to deploy.

Context tokens come first and see only earlier context tokens; query tokens come after, and
each sees its own prefix of the context and itself.  So one encoding of a context serves
many queries in training, and a decision costs one token in deployment.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

_AT_ONCE = 1024
"""Tokens that a decoder appends at once on a CPU: what a layer makes of them stays in the core's cache."""

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

    def remember(self, x: Float[Tensor, "B T D"]) -> tuple[Tensor, Tensor]:
        """Key and value of each token, as ``project`` gives them: all that a last layer is asked for."""
        b, t, d = x.shape
        kv = F.linear(self.norm_attention(x), self.qkv.weight[d:], self.qkv.bias[d:]).view(b, t, 2, self.heads, d // self.heads)
        k, v = kv.permute(2, 0, 3, 1, 4)
        return k, v

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

    def encode(self, x: Float[Tensor, "B T D"]) -> Cache:
        """Keys and values of context tokens x, each of which sees itself and those before it."""
        cache: Cache = []
        for block in self.blocks:
            assert isinstance(block, Block)
            if len(cache) + 1 == len(self.blocks):
                cache.append(block.remember(x))
            else:
                q, k, v = block.project(x)
                cache.append((k, v))
                x = block.finish(x, F.scaled_dot_product_attention(q, k, v, is_causal=True))
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


Linear = tuple[Tensor, Tensor]
"""Weight and bias."""


class _Layer(NamedTuple):
    """A block whose keys and values are absorbed into its queries and its output."""

    heads: int
    norm_attention: Linear
    ask: Linear
    """Normed token to ``heads`` queries ``(heads * D)``, to be compared with normed tokens."""
    out: Linear
    """``heads`` mixtures of normed tokens to what is added to the residual stream."""
    norm_feed: Linear
    widen: Linear
    narrow: Linear

    @classmethod
    def of(cls, block: Block) -> _Layer:
        d, heads = block.out.in_features, block.heads
        e = d // heads
        wq, wk, wv = block.qkv.weight.view(3, heads, e, d)
        bq, _, bv = block.qkv.bias.view(3, heads, e)
        # A key's bias adds the same to every score of a query, so softmax forgets it; a value's
        # bias passes through, for weights sum to 1.
        ask = torch.einsum("hed,hef->hfd", wq, wk).reshape(heads * d, d), torch.einsum("he,hef->hf", bq, wk).flatten()
        out = torch.einsum("ohe,hef->ohf", block.out.weight.view(d, heads, e), wv).reshape(d, heads * d)
        return cls(
            heads,
            copied(block.norm_attention),
            (ask[0] * e**-0.5, ask[1] * e**-0.5),
            (out, block.out.bias + block.out.weight @ bv.flatten()),
            copied(block.norm_feed),
            copied(block.feed[0]),
            copied(block.feed[2]),
        )

    def finish(self, x: Float[Tensor, "*B D"], mixed: Float[Tensor, "*B HD"]) -> Float[Tensor, "*B D"]:
        """The residual stream after attention has been computed."""
        x = x + F.linear(mixed, *self.out)
        return x + F.linear(F.gelu(F.linear(_normed(x, self.norm_feed), *self.widen)), *self.narrow)


class Decoder:
    """A trunk for deployment: B contexts that grow, and queries that each see the whole of theirs.

    A decision reads the whole context once a layer, and at B in the hundreds that reading is
    its cost.  Query and key meet in (W_q n) . (W_k m) = (W_k^T W_q n) . m, and a mixture of
    values is W_v times the mixture of tokens, so a layer keeps one normed token m where keys
    and values would be two.  Weights are copied: a decoder does not follow later training,
    and has no dropout.  It knows no gradients: call it in inference mode.
    """

    def __init__(self, trunk: GPT, batch: int) -> None:
        with torch.no_grad():
            self._layers = [_Layer.of(cast(Block, block)) for block in trunk.blocks]
            self._norm = copied(trunk.norm)
        self._batch = batch
        self.clear()

    @property
    def length(self) -> int:
        """Tokens in each context."""
        return self._tokens[0].shape[1] - 1

    def clear(self) -> None:
        """Forget every context."""
        # The last place is a query's.  None is spare: where a gap parts one context from the next
        # the processor does not read ahead, and large batches are decided much more slowly.
        self._keep([self._norm[0].new_empty(self._batch, 1, len(self._norm[0])) for _ in self._layers])

    def _keep(self, tokens: list[Tensor]) -> None:
        """Keep these tokens of every layer, and the views of them that decisions need."""
        self._tokens = tokens
        self._views = [
            (layer, kept[:, -1], kept.transpose(1, 2), kept) for layer, kept in zip(self._layers, tokens, strict=True)
        ]

    def append(self, x: Float[Tensor, "B T D"]) -> None:
        """Append embedded tokens to the contexts; each sees its whole context up to itself."""
        past, (batch, new, width) = self.length, x.shape
        longer = [kept.new_empty(batch, past + new + 1, width) for kept in self._tokens]
        for kept, now in zip(self._tokens, longer, strict=True):
            now[:, :past] = kept[:, :past]
        self._keep(longer)
        rows = max(1, _AT_ONCE // max(1, new)) if x.device.type == "cpu" else batch
        for start in range(0, batch, rows):
            self._append(x[start : start + rows], [kept[start : start + rows] for kept in self._tokens], past)

    def _append(self, x: Float[Tensor, "B T D"], rows: list[Tensor], past: int) -> None:
        batch, new, width = x.shape
        seen = None if past == 0 else torch.ones(new, past + new, dtype=torch.bool, device=x.device).tril(past)
        for layer, kept in zip(self._layers, rows, strict=True):
            normed = _normed(x, layer.norm_attention)
            kept[:, past:-1] = normed
            if layer is self._layers[-1]:
                return
            q = F.linear(normed, *layer.ask).view(batch, new, layer.heads, width).transpose(1, 2)
            tokens = kept[:, None, :-1].expand(-1, layer.heads, -1, -1)
            mixed = F.scaled_dot_product_attention(q, tokens, tokens, attn_mask=seen, is_causal=past == 0, scale=1.0)
            x = layer.finish(x, mixed.transpose(1, 2).flatten(2))

    def query(self, x: Float[Tensor, "B D"]) -> Float[Tensor, "B D"]:
        """Final states of one query token a context, which sees its context and itself."""
        for layer, place, keys, values in self._views:
            normed = _normed(x, layer.norm_attention)
            place.copy_(normed)
            q = F.linear(normed, *layer.ask).view(self._batch, layer.heads, -1)
            x = layer.finish(x, torch.bmm(torch.bmm(q, keys).softmax(-1), values).view(self._batch, -1))
        return _normed(x, self._norm)


def _normed(x: Float[Tensor, "*B D"], norm: Linear) -> Float[Tensor, "*B D"]:
    return torch.layer_norm(x, x.shape[-1:], *norm)


def copied(module: nn.Module) -> Linear:
    """Weight and bias of a layer, which later training does not change."""
    return cast(Tensor, module.weight).detach().clone(), cast(Tensor, module.bias).detach().clone()
