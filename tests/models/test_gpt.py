"""The trunk against a slow loop, token by token and number by number."""

from __future__ import annotations

import math

import pytest
import torch

from icrl_dist.models.gpt import GPT, Block
from tests.models.networks import build


def slow_linear(x: list[float], layer: torch.nn.Module) -> list[float]:
    assert isinstance(layer, torch.nn.Linear)
    weight, bias = layer.weight.tolist(), layer.bias.tolist()
    return [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in zip(weight, bias, strict=True)]


def slow_norm(x: list[float], layer: torch.nn.LayerNorm) -> list[float]:
    mean = sum(x) / len(x)
    deviation = math.sqrt(sum((v - mean) ** 2 for v in x) / len(x) + 1e-5)
    weight, bias = layer.weight.tolist(), layer.bias.tolist()
    return [(v - mean) / deviation * w + b for v, w, b in zip(x, weight, bias, strict=True)]


def slow_trunk(trunk: GPT, tokens: list[list[float]], query: list[float]) -> list[float]:
    """The state of a query that sees every context token and itself; context tokens are causal."""
    xs = [*tokens, query]
    for block in trunk.blocks:
        assert isinstance(block, Block)
        width = len(query)
        projected = [slow_linear(slow_norm(x, block.norm_attention), block.qkv) for x in xs]
        d = width // block.heads
        after = []
        for i, x in enumerate(xs):
            attended: list[float] = []
            for head in range(block.heads):
                q = projected[i][head * d : (head + 1) * d]
                keys = [projected[j][width + head * d : width + (head + 1) * d] for j in range(i + 1)]
                values = [projected[j][2 * width + head * d : 2 * width + (head + 1) * d] for j in range(i + 1)]
                score = [math.exp(sum(a * b for a, b in zip(q, k, strict=True)) / math.sqrt(d)) for k in keys]
                attended += [sum(s * v[c] for s, v in zip(score, values, strict=True)) / sum(score) for c in range(d)]
            x = [a + b for a, b in zip(x, slow_linear(attended, block.out), strict=True)]
            hidden = slow_linear(slow_norm(x, block.norm_feed), block.feed[0])
            hidden = [0.5 * v * (1 + math.erf(v / math.sqrt(2))) for v in hidden]
            after.append([a + b for a, b in zip(x, slow_linear(hidden, block.feed[2]), strict=True)])
        xs = after
    return slow_norm(xs[-1], trunk.norm)


@torch.no_grad()
@pytest.mark.parametrize(("layers", "heads"), [(1, 1), (1, 2), (3, 2)])
def test_the_trunk_equals_the_slow_loop(layers: int, heads: int) -> None:
    trunk = build(layers, heads, width=8).trunk.double()
    g = torch.Generator().manual_seed(3)
    tokens = torch.randn(1, 5, 8, generator=g, dtype=torch.float64)
    queries = torch.randn(1, 2, 8, generator=g, dtype=torch.float64)
    prefix = [5, 2]
    visible = torch.arange(5) < torch.tensor(prefix)[None, :, None]
    fast = trunk.query(queries, trunk.encode(tokens), visible)
    for n, length in enumerate(prefix):
        slow = slow_trunk(trunk, tokens[0, :length].tolist(), queries[0, n].tolist())
        assert fast[0, n].tolist() == pytest.approx(slow, abs=1e-9)
