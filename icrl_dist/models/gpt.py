"""A causal GPT-2 trunk in two forms: ``GPT`` to train, ``Decoder`` to deploy.

Context tokens come first and see only earlier context tokens; query tokens come after, and
each sees its own prefix of the context, those before it in its window, and itself.  So one
encoding of a context serves many queries in training, and a decision costs one token in
deployment, or as many as its window is long.
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
        self, x: Float[Tensor, "B Q D"], cache: Cache, seen: Bool[Tensor, "B #Q T"] | None = None, window: int = 1
    ) -> Float[Tensor, "B Q D"]:
        """Final states of query tokens x, each seeing the context tokens ``seen`` and itself.

        ``seen=None`` shows every query the whole context.  Every ``window`` tokens in a row are a
        window: each of them also sees those of it that come before.
        """
        for block, (keys, values) in zip(self.blocks, cache, strict=True):
            assert isinstance(block, Block)
            q, k, v = block.project(x)
            scale = q.shape[-1] ** -0.5
            to_context = (q @ keys.transpose(2, 3)) * scale
            if seen is not None:
                to_context = to_context.masked_fill(~seen[:, None], float("-inf"))
            weight = torch.cat([to_context, _own(q, k, window) * scale], dim=-1).softmax(dim=-1)
            to_context, to_own = weight[..., :-window], weight[..., -window:]
            own = to_own * v if window == 1 else (_windows(to_own, window) @ _windows(v, window)).flatten(2, 3)
            x = block.finish(x, to_context @ values + own)
        result: Tensor = self.norm(x)
        return result


def _windows(x: Float[Tensor, "B N Q d"], window: int) -> Float[Tensor, "B N R L d"]:
    return x.reshape(*x.shape[:2], -1, window, x.shape[3])


def _own(q: Float[Tensor, "B N Q d"], k: Float[Tensor, "B N Q d"], window: int) -> Float[Tensor, "B N Q L"]:
    """How each query scores the tokens of its own window: -inf for those after it."""
    if window == 1:
        return (q * k).sum(-1, keepdim=True)
    scores = _windows(q, window) @ _windows(k, window).transpose(3, 4)
    return scores.masked_fill(~_causal(window, q.device), float("-inf")).flatten(2, 3)


def _causal(length: int, device: torch.device) -> Bool[Tensor, "L L"]:
    return torch.ones(length, length, dtype=torch.bool, device=device).tril()


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
        return self._tokens[0].shape[1] - 1 + self._recent

    def clear(self) -> None:
        """Forget every context."""
        self._recent = 0
        self._fresh = [self._norm[0].new_empty(self._batch, 0, len(self._norm[0])) for _ in self._layers]
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
        self._settle()
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

    def window(self, x: Float[Tensor, "B L D"], arrived: Float[Tensor, "B D"] | None = None) -> Float[Tensor, "B D"]:
        """Final state of the last token of one window a context: each sees its context, those before it, and itself.

        A token that has ``arrived`` joins the context first.
        """
        batch, length, width = x.shape
        new = int(arrived is not None)
        if arrived is not None:
            self._make_room()
            x = torch.cat([arrived[:, None], x], dim=1)
        hidden = torch.cat([torch.ones(new, length, dtype=torch.bool, device=x.device), ~_causal(length, x.device)])
        self._recent += new
        for layer, tokens, fresh in zip(self._layers, self._tokens, self._fresh, strict=True):
            normed = _normed(x, layer.norm_attention)
            if new:
                fresh[:, self._recent - 1] = normed[:, 0]
            seen = (tokens[:, :-1], fresh[:, : self._recent], normed[:, new:])
            q = F.linear(normed, *layer.ask).view(batch, -1, width)
            scores = [torch.bmm(q, part.transpose(1, 2)) for part in seen]
            scores[2].masked_fill_(hidden.repeat_interleave(layer.heads, dim=0), float("-inf"))
            weights = torch.split(torch.cat(scores, dim=-1).softmax(-1), [part.shape[1] for part in seen], dim=-1)
            mixed = sum(torch.bmm(weight, part) for weight, part in zip(weights, seen, strict=True))
            x = layer.finish(x, cast(Tensor, mixed).view(batch, new + length, -1))
        return _normed(x[:, -1], self._norm)

    def _make_room(self) -> None:
        """For one more token that arrives by itself: they stand apart, with room to spare, until they are settled."""
        if self._recent == self._fresh[0].shape[1]:
            self._fresh = [torch.cat([f, f.new_empty(f.shape[0], 32 + f.shape[1], f.shape[2])], dim=1) for f in self._fresh]

    def _settle(self) -> None:
        """Put the tokens that arrived one by one with the others, where they are read faster."""
        if self._recent:
            pieces = zip(self._tokens, self._fresh, strict=True)
            settled = [torch.cat([t[:, :-1], f[:, : self._recent], t[:, -1:]], dim=1) for t, f in pieces]
            self._recent = 0
            self._keep(settled)

    def query(self, x: Float[Tensor, "B D"]) -> Float[Tensor, "B D"]:
        """Final states of one query token a context, which sees its context and itself."""
        self._settle()
        for layer, place, keys, values in self._views:
            normed = _normed(x, layer.norm_attention)
            place.copy_(normed)
            q = F.linear(normed, *layer.ask).view(self._batch, layer.heads, -1)
            x = layer.finish(x, torch.bmm(torch.bmm(q, keys).softmax(-1), values).view(self._batch, -1))
        return _normed(x, self._norm)

    def peek(self, row: int, x: Float[Tensor, "Q D"], arrived: Float[Tensor, "E D"]) -> Float[Tensor, "Q D"]:
        """Final states of query tokens, each of which sees the whole of context ``row`` and itself.

        They also see tokens that have ``arrived``, as if these had joined the context.  Nothing of the
        decoder changes.
        """
        new, queries = len(arrived), len(x)
        x = torch.cat([arrived, x])
        hidden = ~torch.eye(new + queries, dtype=torch.bool, device=x.device)
        hidden[:, :new] = ~_causal(new + queries, x.device)[:, :new]
        for layer, tokens, fresh in zip(self._layers, self._tokens, self._fresh, strict=True):
            normed = _normed(x, layer.norm_attention)
            seen = torch.cat([tokens[row, :-1], fresh[row, : self._recent], normed])
            q = F.linear(normed, *layer.ask).view(len(x), layer.heads, -1)
            scores = q @ seen.T
            scores[..., -len(x) :].masked_fill_(hidden[:, None], float("-inf"))
            x = layer.finish(x, (scores.softmax(-1) @ seen).flatten(1))
        return _normed(x[new:], self._norm)


def _normed(x: Float[Tensor, "*B D"], norm: Linear) -> Float[Tensor, "*B D"]:
    return torch.layer_norm(x, x.shape[-1:], *norm)


def copied(module: nn.Module) -> Linear:
    """Weight and bias of a layer, which later training does not change."""
    return cast(Tensor, module.weight).detach().clone(), cast(Tensor, module.bias).detach().clone()
