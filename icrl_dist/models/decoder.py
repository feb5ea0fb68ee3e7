"""The trunk of ``models.gpt`` for deployment: B growing contexts, and queries that see all of theirs.

A decision reads the whole context once per layer, and with hundreds of environments this reading is
its cost.  So a layer stores one tensor per context token instead of a key and a value, by this
identity (n, m: a query's and a context token's normalized state; W_q, W_k, W_v: the projections)::

    score  = (W_q n) . (W_k m) = (W_k^T W_q n) . m
    output = sum_m weight_m W_v m = W_v (sum_m weight_m m)

``W_k^T W_q`` and ``W_out W_v`` are multiplied out once, when a decoder is made.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from icrl_dist.models.gpt import GPT, Block, causal_mask

_TOKENS_AT_ONCE = 1024
"""Tokens that ``append`` processes together on a CPU, so that a layer's activations stay in the core's cache."""

Linear = tuple[Tensor, Tensor]
"""Weight and bias."""


class _Layer(NamedTuple):
    """A ``Block`` with W_k multiplied into the queries and W_v into the output projection."""

    heads: int
    norm_attention: Linear
    query: Linear
    """Normalized token to ``heads`` queries ``(heads * D)``, which are compared with normalized tokens."""
    out: Linear
    """One weighted sum of normalized tokens per head to attention's addition to the residual stream."""
    norm_mlp: Linear
    mlp_up: Linear
    mlp_down: Linear

    @classmethod
    def of(cls, block: Block) -> _Layer:
        d, heads = block.out.in_features, block.heads
        e = d // heads
        # Rows of the projection are (q | k | v), then heads, then the numbers of a head: split them alike.
        wq, wk, wv = block.qkv.weight.view(3, heads, e, d)
        bq, _, bv = block.qkv.bias.view(3, heads, e)
        # A key's bias adds the same number to every score of a query, so softmax cancels it; a value's
        # bias passes through unchanged, because attention weights sum to 1.
        query = torch.einsum("hed,hef->hfd", wq, wk).reshape(heads * d, d), torch.einsum("he,hef->hf", bq, wk).flatten()
        out = torch.einsum("ohe,hef->ohf", block.out.weight.view(d, heads, e), wv).reshape(d, heads * d)
        return cls(
            heads,
            weight_and_bias(block.norm_attention),
            (query[0] * e**-0.5, query[1] * e**-0.5),
            (out, block.out.bias + block.out.weight @ bv.flatten()),
            weight_and_bias(block.norm_feed),
            weight_and_bias(block.feed[0]),
            weight_and_bias(block.feed[2]),
        )

    def attn_out_and_mlp(self, x: Float[Tensor, "*B D"], mixed: Float[Tensor, "*B HD"]) -> Float[Tensor, "*B D"]:
        """Add attention's output and then the MLP's to the residual stream ``x``."""
        x = x + F.linear(mixed, *self.out)
        return x + F.linear(F.gelu(F.linear(_layer_norm(x, self.norm_mlp), *self.mlp_up)), *self.mlp_down)


class Decoder:
    """A trunk with B growing contexts.  Weights are copied: later training does not change them.

    It has no dropout and computes no gradients: call it in inference mode.
    """

    def __init__(self, trunk: GPT, batch: int) -> None:
        with torch.no_grad():
            self._layers = [_Layer.of(cast(Block, block)) for block in trunk.blocks]
            self._norm = weight_and_bias(trunk.norm)
        self._batch = batch
        self.clear()

    @property
    def length(self) -> int:
        """Tokens in each context."""
        return self._tokens[0].shape[1] - 1 + self._recent_count

    def clear(self) -> None:
        """Empty every context."""
        self._recent_count = 0
        self._recent = [self._norm[0].new_empty(self._batch, 0, len(self._norm[0])) for _ in self._layers]
        # The last position is the query's.  There is no spare room: with a gap between one context and
        # the next the processor does not prefetch, and large batches are decided much more slowly.
        self._set_tokens([self._norm[0].new_empty(self._batch, 1, len(self._norm[0])) for _ in self._layers])

    def _set_tokens(self, tokens: list[Tensor]) -> None:
        """Store each layer's tokens, and make the views of them that ``query`` needs."""
        self._tokens = tokens
        self._views = [(layer, of[:, -1], of.transpose(1, 2), of) for layer, of in zip(self._layers, tokens, strict=True)]

    def __getstate__(self) -> dict[str, Any]:
        """Without the views: a pickled view would be a tensor of its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_views"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._set_tokens(self._tokens)

    def append(self, x: Float[Tensor, "B T D"]) -> None:
        """Append embedded tokens to the contexts; each token sees its whole context up to itself."""
        self._merge_recent()
        past, (batch, new, width) = self.length, x.shape
        longer = [tokens.new_empty(batch, past + new + 1, width) for tokens in self._tokens]
        for old, now in zip(self._tokens, longer, strict=True):
            now[:, :past] = old[:, :past]
        self._set_tokens(longer)
        rows = max(1, _TOKENS_AT_ONCE // max(1, new)) if x.device.type == "cpu" else batch
        for start in range(0, batch, rows):
            self._append(x[start : start + rows], [tokens[start : start + rows] for tokens in self._tokens], past)

    def _append(self, x: Float[Tensor, "B T D"], rows: list[Tensor], past: int) -> None:
        batch, new, width = x.shape
        visible = None if past == 0 else torch.ones(new, past + new, dtype=torch.bool, device=x.device).tril(past)
        for layer, tokens in zip(self._layers, rows, strict=True):
            normed = _layer_norm(x, layer.norm_attention)
            tokens[:, past:-1] = normed
            if layer is self._layers[-1]:
                return
            # (B, T, heads * D) -> (B, heads, T, D): a batched product over heads; all heads share the tokens.
            q = F.linear(normed, *layer.query).view(batch, new, layer.heads, width).transpose(1, 2)
            shared = tokens[:, None, :-1].expand(-1, layer.heads, -1, -1)
            mixed = F.scaled_dot_product_attention(q, shared, shared, attn_mask=visible, is_causal=past == 0, scale=1.0)
            x = layer.attn_out_and_mlp(x, mixed.transpose(1, 2).flatten(2))

    def window(self, x: Float[Tensor, "B L D"], arrived: Float[Tensor, "B D"] | None = None) -> Float[Tensor, "B D"]:
        """Final state of the last token of one window per context.

        Each token of the window sees its context, the tokens before it in the window, and itself.  A
        token ``arrived`` joins the context first.
        """
        batch, length, width = x.shape
        new = int(arrived is not None)
        if arrived is not None:
            self._reserve_recent()
            x = torch.cat([arrived[:, None], x], dim=1)
        # The arrived token is in the context, so its row sees no token of the window.
        hidden = torch.cat([torch.ones(new, length, dtype=torch.bool, device=x.device), ~causal_mask(length, x.device)])
        self._recent_count += new
        for layer, tokens, recent in zip(self._layers, self._tokens, self._recent, strict=True):
            normed = _layer_norm(x, layer.norm_attention)
            if new:
                recent[:, self._recent_count - 1] = normed[:, 0]
            visible = (tokens[:, :-1], recent[:, : self._recent_count], normed[:, new:])
            # (B, new + L, heads * D) -> (B, (new + L) * heads, D): all heads share the tokens, so the
            # queries of all heads are rows of one product.
            q = F.linear(normed, *layer.query).view(batch, -1, width)
            scores = [torch.bmm(q, part.transpose(1, 2)) for part in visible]
            scores[2].masked_fill_(hidden.repeat_interleave(layer.heads, dim=0), float("-inf"))
            weights = torch.split(torch.cat(scores, dim=-1).softmax(-1), [part.shape[1] for part in visible], dim=-1)
            mixed = sum(torch.bmm(weight, part) for weight, part in zip(weights, visible, strict=True))
            # Heads of a token side by side again: (B, new + L, heads * D).
            x = layer.attn_out_and_mlp(x, cast(Tensor, mixed).view(batch, new + length, -1))
        return _layer_norm(x[:, -1], self._norm)

    def _reserve_recent(self) -> None:
        """Make room for one more token that arrives by itself.

        Such tokens are stored apart, in a buffer with spare room, until ``_merge_recent``: appending
        them one by one to the tight buffer would copy every context each time.
        """
        if self._recent_count == self._recent[0].shape[1]:
            self._recent = [
                torch.cat([old, old.new_empty(old.shape[0], 32 + old.shape[1], old.shape[2])], dim=1) for old in self._recent
            ]

    def _merge_recent(self) -> None:
        """Move the tokens that arrived one by one into the tight buffer, which is faster to read."""
        if self._recent_count:
            pieces = zip(self._tokens, self._recent, strict=True)
            merged = [torch.cat([t[:, :-1], new[:, : self._recent_count], t[:, -1:]], dim=1) for t, new in pieces]
            self._recent_count = 0
            self._set_tokens(merged)

    def query(self, x: Float[Tensor, "B D"]) -> Float[Tensor, "B D"]:
        """Final states of one query token per context, which sees its context and itself."""
        self._merge_recent()
        for layer, query_place, keys, values in self._views:
            normed = _layer_norm(x, layer.norm_attention)
            query_place.copy_(normed)
            # (B, heads * D) -> (B, heads, D): one query per head against the shared tokens.
            q = F.linear(normed, *layer.query).view(self._batch, layer.heads, -1)
            x = layer.attn_out_and_mlp(x, torch.bmm(torch.bmm(q, keys).softmax(-1), values).view(self._batch, -1))
        return _layer_norm(x, self._norm)

    def query_row(self, row: int, x: Float[Tensor, "Q D"], appended: Float[Tensor, "E D"]) -> Float[Tensor, "Q D"]:
        """Final states of Q query tokens, each of which sees the whole of context ``row`` and itself.

        They also see the ``appended`` tokens, as if these had joined the context.  The decoder does not change.
        """
        new, queries = len(appended), len(x)
        x = torch.cat([appended, x])
        # A query sees itself and no other query; appended tokens are causal and visible to every query.
        hidden = ~torch.eye(new + queries, dtype=torch.bool, device=x.device)
        hidden[:, :new] = ~causal_mask(new + queries, x.device)[:, :new]
        for layer, tokens, recent in zip(self._layers, self._tokens, self._recent, strict=True):
            normed = _layer_norm(x, layer.norm_attention)
            visible = torch.cat([tokens[row, :-1], recent[row, : self._recent_count], normed])
            # (E + Q, heads * D) -> (E + Q, heads, D): all heads share the tokens.
            q = F.linear(normed, *layer.query).view(len(x), layer.heads, x.shape[1])
            scores = q @ visible.T
            scores[..., -len(x) :].masked_fill_(hidden[:, None], float("-inf"))
            x = layer.attn_out_and_mlp(x, (scores.softmax(-1) @ visible).flatten(1))
        return _layer_norm(x[new:], self._norm)


def weight_and_bias(module: nn.Module) -> Linear:
    """Copies of a layer's weight and bias, which later training does not change."""
    return cast(Tensor, module.weight).detach().clone(), cast(Tensor, module.bias).detach().clone()


def _layer_norm(x: Float[Tensor, "*B D"], norm: Linear) -> Float[Tensor, "*B D"]:
    return torch.layer_norm(x, x.shape[-1:], *norm)
