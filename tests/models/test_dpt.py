"""The transformer: one encoding serves every query, nobody sees what it must not, and it learns."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.models import gpt
from icrl_dist.models.dpt import Deployed, PretrainedTransformer, Transitions
from icrl_dist.models.gpt import GPT
from icrl_dist.models.heads import Categorical
from icrl_dist.models.weights import load_weights, weights_of
from icrl_dist.training import batches, fit
from icrl_dist.training.batches import Batch, Examples, Pool
from icrl_dist.types import Spec

SPEC = Spec(low=(0.0, 0.0), high=(4.0, 4.0), actions=5, horizon=8)
B, T, Q = 3, 20, 6


def build(layers: int = 3, heads: int = 2, width: int = 16, fourier: int = 0, spec: Spec = SPEC) -> PretrainedTransformer:
    """A model whose every parameter matters: none is zero, and attention is far from flat."""
    torch.manual_seed(0)
    model = PretrainedTransformer(spec, ModelConfig(layers, heads, width, fourier))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.4)
    return model.eval()


def transitions(length: int = T, seed: int = 0, rows: int = B) -> Transitions:
    g = torch.Generator().manual_seed(seed)
    cells = torch.randint(0, 5, (rows, length + 1, 2), generator=g).float()
    actions = torch.randint(0, 5, (rows, length), generator=g)
    return Transitions(cells[:, :-1], actions, cells[:, 1:], torch.randint(0, 2, (rows, length), generator=g).float())


def states(count: int = Q, seed: int = 9) -> Tensor:
    return torch.randint(0, 5, (B, count, 2), generator=torch.Generator().manual_seed(seed)).float()


def part(of: Transitions, start: int, stop: int) -> Transitions:
    return Transitions(*(column[:, start:stop] for column in of))


def changed(of: Transitions, at: int) -> Transitions:
    """The context with another transition number ``at``, in every one of its columns."""
    copies = Transitions(*(column.clone() for column in of))
    for column in (copies.observations, copies.next_observations):
        column[:, at] = 4 - column[:, at] + 0.5
    copies.actions[:, at] = (copies.actions[:, at] + 1) % 5
    copies.rewards[:, at] = 1 - copies.rewards[:, at]
    return copies


@torch.no_grad()
@pytest.mark.parametrize(("heads", "width"), [(1, 32), (2, 32), (1, 64), (4, 64)])
@pytest.mark.parametrize("cuts", [(0, 20), (0, 7, 20), (0, 0, 1, 2, 19, 20), tuple(range(21))], ids=str)
def test_a_deployed_context_grown_in_pieces_decides_as_in_training(cuts: tuple[int, ...], heads: int, width: int) -> None:
    model, whole, queries = build(3, heads, width), transitions(), states(T + 1)
    prefixes = model(whole, queries, torch.arange(T + 1).repeat(B, 1))
    deployed = Deployed(model, B)
    for start, stop in itertools.pairwise(cuts):
        deployed.append(part(whole, start, stop))
        assert deployed.length == stop
        for _ in range(2):  # A decision leaves nothing behind.
            torch.testing.assert_close(deployed.decide(queries[:, stop]), prefixes[:, stop], atol=1e-5, rtol=1e-5)
    assert prefixes.std(dim=1).min() > 1e-3, "the queries all answer alike: this would prove nothing"


@torch.no_grad()
@pytest.mark.parametrize("tokens", [1, 25, 40, 10_000])
def test_contexts_appended_some_at_a_time_are_the_same(tokens: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model, whole, queries = build(), transitions(), states()[:, 0]
    monkeypatch.setattr(gpt, "_AT_ONCE", tokens)
    deployed = Deployed(model, B)
    for start, stop in ((0, 11), (11, T)):
        deployed.append(part(whole, start, stop))
    expected = model(whole, queries[:, None], torch.full((B, 1), T))[:, 0]
    torch.testing.assert_close(deployed.decide(queries), expected, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_a_cleared_context_is_an_empty_one_and_later_training_does_not_reach_it() -> None:
    model, queries = build(), states()[:, 0]
    deployed = Deployed(model, B)
    empty = deployed.decide(queries)
    torch.testing.assert_close(
        empty, model(transitions(), queries[:, None], torch.zeros(B, 1, dtype=torch.int64))[:, 0], atol=1e-5, rtol=1e-5
    )
    deployed.append(transitions())
    full = deployed.decide(queries)
    assert (full - empty).abs().amax() > 1e-3
    for parameter in model.parameters():
        parameter.mul_(1.5)
    torch.testing.assert_close(deployed.decide(queries), full, atol=0, rtol=0)
    deployed.clear()
    assert deployed.length == 0
    torch.testing.assert_close(deployed.decide(queries), empty, atol=0, rtol=0)


@torch.no_grad()
def test_a_prefix_is_a_shorter_context() -> None:
    model, whole, queries = build(), transitions(), states(T + 1)
    together = model(whole, queries, torch.arange(T + 1).repeat(B, 1))
    for n in range(T + 1):
        alone = model.decide(queries[:, n : n + 1], model.encode(part(whole, 0, n)))
        torch.testing.assert_close(together[:, n : n + 1], alone, atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("at", [0, 6, 7, 19])
def test_a_query_sees_its_prefix_and_nothing_after(at: int) -> None:
    model, queries = build(), states(T + 1)
    prefix = torch.arange(T + 1).repeat(B, 1)
    before, after = (model(c, queries, prefix) for c in (transitions(), changed(transitions(), at)))
    difference = (before - after).abs().amax(dim=(0, 2))
    assert (difference[: at + 1] < 1e-6).all(), "a prediction moved with a transition after its prefix"
    assert (difference[at + 1 :] > 1e-4).all(), "a prediction ignores a transition of its prefix"


@torch.no_grad()
@pytest.mark.parametrize("column", Transitions._fields)
def test_every_column_of_a_transition_counts(column: str) -> None:
    model, context_, queries = build(), transitions(), states()
    other = context_._replace(**{column: getattr(changed(context_, 5), column)})
    logits = [model.decide(queries, model.encode(c)) for c in (context_, other)]
    assert (logits[0] - logits[1]).abs().amax() > 1e-4


@torch.no_grad()
def test_queries_do_not_see_one_another() -> None:
    model, context_, queries = build(), transitions(), states()
    prefix = torch.randint(0, T + 1, (B, Q), generator=torch.Generator().manual_seed(1))
    together = model(context_, queries, prefix)
    for n in range(Q):
        alone = model(context_, queries[:, n : n + 1], prefix[:, n : n + 1])
        torch.testing.assert_close(together[:, n : n + 1], alone, atol=1e-6, rtol=1e-5)
    assert together.std(dim=1).min() > 1e-3, "the queries all answer alike: this would prove nothing"


@torch.no_grad()
def test_padding_at_the_end_changes_nothing() -> None:
    model, context_, queries = build(), transitions(), states()
    prefix = torch.randint(0, T + 1, (B, Q), generator=torch.Generator().manual_seed(1))
    padded = Transitions(*(torch.cat([c, torch.zeros_like(c[:, :9])], dim=1) for c in context_))
    torch.testing.assert_close(model(padded, queries, prefix), model(context_, queries, prefix), atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_rows_of_a_batch_do_not_see_one_another() -> None:
    model, queries = build(), states()
    logits = model.decide(queries, model.encode(transitions()))
    one = Transitions(*(c[1:2] for c in transitions()))
    torch.testing.assert_close(model.decide(queries[1:2], model.encode(one)), logits[1:2], atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_an_empty_context_decides_from_the_query_alone() -> None:
    model = build()
    logits = model.decide(states(), model.encode(transitions(0)))
    assert torch.isfinite(logits).all()
    torch.testing.assert_close(
        logits, model(transitions(), states(), torch.zeros(B, Q, dtype=torch.int64)), atol=1e-6, rtol=1e-5
    )


@torch.no_grad()
def test_scaled_observations_and_fourier_features() -> None:
    corners = torch.tensor([[0.0, 0.0], [4.0, 4.0], [2.0, 1.0]])
    torch.testing.assert_close(build().features(corners), torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, -0.5]]))
    waves = build(fourier=2).features(corners)[2]
    slow = [0.0, -0.5]
    for k in (1, 2):
        slow += [math.sin(math.pi / 2 * k * x) for x in (0.0, -0.5)] + [math.cos(math.pi / 2 * k * x) for x in (0.0, -0.5)]
    assert waves.tolist() == pytest.approx(slow, abs=1e-6)


# The trunk once more, token by token and number by number.


def slow_linear(x: list[float], layer: torch.nn.Module) -> list[float]:
    weight, bias = layer.weight.tolist(), layer.bias.tolist()  # type: ignore[operator, union-attr]
    return [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in zip(weight, bias, strict=True)]


def slow_norm(x: list[float], layer: torch.nn.Module) -> list[float]:
    mean = sum(x) / len(x)
    deviation = math.sqrt(sum((v - mean) ** 2 for v in x) / len(x) + 1e-5)
    weight, bias = layer.weight.tolist(), layer.bias.tolist()  # type: ignore[operator, union-attr]
    return [(v - mean) / deviation * w + b for v, w, b in zip(x, weight, bias, strict=True)]


def slow_trunk(trunk: GPT, tokens: list[list[float]], query: list[float]) -> list[float]:
    """The state of a query that sees every context token and itself, each of which sees those before it."""
    xs = [*tokens, query]
    for block in trunk.blocks:
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
def test_trunk_equals_the_slow_loop(layers: int, heads: int) -> None:
    trunk = build(layers, heads, width=8).trunk.double()
    g = torch.Generator().manual_seed(3)
    tokens = torch.randn(1, 5, 8, generator=g, dtype=torch.float64)
    queries = torch.randn(1, 2, 8, generator=g, dtype=torch.float64)
    prefix = [5, 2]
    seen = torch.arange(5) < torch.tensor(prefix)[None, :, None]
    fast = trunk.query(queries, trunk.encode(tokens), seen)
    for n, length in enumerate(prefix):
        slow = slow_trunk(trunk, tokens[0, :length].tolist(), queries[0, n].tolist())
        assert fast[0, n].tolist() == pytest.approx(slow, abs=1e-9)


# The loss and the fit.


def test_loss_is_equation_1() -> None:
    rng = np.random.default_rng(0)
    logits, labels = rng.normal(size=(3, 4, 5)), rng.dirichlet([0.5] * 5, size=(3, 4))
    total = 0.0
    for row in range(3):
        for query in range(4):
            partition = sum(math.exp(v) for v in logits[row, query])
            for action in range(5):
                total -= labels[row, query, action] * math.log(math.exp(logits[row, query, action]) / partition)
    head = Categorical(5)
    assert head.loss(torch.tensor(logits), torch.tensor(labels)).item() == pytest.approx(total / 12)
    assert head.loss(torch.zeros(2, 5), torch.eye(5)[:2]).item() == pytest.approx(math.log(5))


def two_cells(goal: int, rng: np.random.Generator) -> Examples:
    """A corridor of two cells: staying is action 0, crossing is action 1, and one cell pays.

    Any one transition says which, so only the empty prefix leaves a doubt.
    """
    cells = rng.integers(0, 2, size=(4, 9))
    actions = (cells[:, 1:] != cells[:, :-1]).astype(np.int64)
    queries = np.array([[0.0], [1.0]], np.float32)
    labels = np.array([[1.0, 0.0], [0.0, 1.0]], np.float32)
    return Examples(
        observations=cells[..., None].astype(np.float32),
        actions=actions,
        rewards=(cells[:, 1:] == goal).astype(np.float32),
        queries=queries,
        labels=labels if goal == 0 else labels[::-1].copy(),
        history=False,
    )


def corridor() -> tuple[PretrainedTransformer, list[Pool]]:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    model = PretrainedTransformer(Spec((0.0,), (1.0,), 2, 8), ModelConfig(layers=2, heads=1, width=16))
    return model, [Pool(1.0, [two_cells(goal, rng) for goal in (0, 1) for _ in range(4)], 1)]


def corridor_batch(pools: list[Pool], step: int) -> Batch:
    return batches.draw(np.random.default_rng(step), pools, 32, 8)


@torch.no_grad()
def test_batch_loss_reads_every_part_of_a_batch() -> None:
    model, pools = corridor()
    batch = corridor_batch(pools, 0)
    columns = [torch.as_tensor(a) for a in (batch.observations, batch.actions, batch.next_observations, batch.rewards)]
    slow = 0.0
    for b in range(32):
        for n in range(8):
            seen = Transitions(*(c[b : b + 1, : batch.prefix[b, n]] for c in columns))
            logits = model.decide(torch.as_tensor(batch.queries[b : b + 1, n : n + 1]), model.encode(seen))
            slow -= float((torch.as_tensor(batch.labels[b, n]) * logits[0, 0].log_softmax(-1)).sum())
    assert fit.batch_loss(model, batch).item() == pytest.approx(slow / 256, rel=1e-4)


def test_every_parameter_gets_a_gradient() -> None:
    model, pools = corridor()
    fit.batch_loss(model, corridor_batch(pools, 0)).backward()
    without = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert without == []


def test_fit_learns_the_corridor() -> None:
    """From log 2 = 0.69 to near the floor: of the prefixes 0 to 8 only 0 leaves a doubt."""
    model, pools = corridor()
    config = OptimConfig(learning_rate=1e-2, batch=32, queries=8, episodes=1, warmup=20)
    seen: list[tuple[int, float]] = []
    final = fit.fit(
        model,
        fit.Optimizer(model, config),
        config,
        config.learning_rate,
        200,
        lambda step: corridor_batch(pools, step),
        lambda step, value: seen.append((step, value)),
    )
    floor = math.log(2) / 9
    assert [step for step, _ in seen] == list(range(1, 201))
    assert seen[0][1] > 0.6
    assert floor - 0.03 < final < floor + 0.05
    assert final == pytest.approx(np.mean([value for _, value in seen[-20:]]))
    assert not model.training


def test_fit_stops_at_a_loss_that_is_no_number() -> None:
    model, pools = corridor()
    config = OptimConfig(learning_rate=0.25)
    with torch.no_grad():
        model.head.bias.fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"nan at step 0: lower the learning rate \(0\.25\)"):
        fit.fit(model, fit.Optimizer(model, config), config, config.learning_rate, 3, lambda step: corridor_batch(pools, step))


def test_rate_rises_then_falls_to_a_tenth() -> None:
    values = [fit.rate(step, 110, 10) for step in range(110)]
    assert values[:10] == pytest.approx([0.1 * (i + 1) for i in range(10)])
    assert values[10] == 1.0
    assert values[60] == pytest.approx(0.55)
    assert all(a > b for a, b in itertools.pairwise(values[10:]))
    assert values[-1] == pytest.approx(0.1, abs=1e-3)


# Weights.


def test_weights_survive_the_trip_and_are_copies() -> None:
    model, other = build(), PretrainedTransformer(SPEC, ModelConfig(3, 2, 16))
    arrays = weights_of(model)
    assert all(a.dtype == np.dtype("<f4") for a in arrays.values())
    frozen = {name: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape) for name, a in arrays.items()}
    load_weights(other, frozen)
    with torch.no_grad():
        args = (transitions(), states(), torch.full((B, Q), T))
        before = model(*args)
        torch.testing.assert_close(other.eval()(*args), before, atol=0, rtol=0)
        for a in arrays.values():
            a[...] = 0
        torch.testing.assert_close(model(*args), before, atol=0, rtol=0)
        for parameter in other.parameters():
            parameter.zero_()
    assert all(a.any() for a in frozen.values()), "writing into the loaded model reached the message"


@pytest.mark.parametrize("wrong", ["shape", "missing", "unknown"])
def test_other_weights_are_refused_by_name(wrong: str) -> None:
    model = build()
    arrays = weights_of(model)
    if wrong == "shape":
        arrays["head.weight"] = arrays["head.weight"][:, :-1]
    elif wrong == "missing":
        del arrays["head.weight"]
    else:
        arrays["head.height"] = np.zeros(3, np.float32)
    with pytest.raises(RuntimeError, match=r"head\.height" if wrong == "unknown" else r"head\.weight"):
        load_weights(model, arrays)
