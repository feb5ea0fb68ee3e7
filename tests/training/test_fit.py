"""The loss against eq. (1) and slow loops, and a fit of a two-cell corridor."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.models.heads import Categorical
from icrl_dist.training import batches, fit
from icrl_dist.training.batches import Examples, Pool, TrainingBatch
from icrl_dist.types import Spec


def test_the_loss_is_equation_1() -> None:
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
    """A corridor of two cells: action 0 stays, action 1 crosses, and one cell has reward 1.

    Any single transition determines the goal, so only with an empty prefix is the label uncertain.
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


def corridor_batch(pools: list[Pool], step: int) -> TrainingBatch:
    return batches.draw(np.random.default_rng(step), pools, 32, 8)


@torch.no_grad()
def test_the_batch_loss_equals_a_slow_loop_over_rows_and_queries() -> None:
    model, pools = corridor()
    batch = corridor_batch(pools, 0)
    columns = [torch.as_tensor(a) for a in (batch.observations, batch.actions, batch.next_observations, batch.rewards)]
    slow = 0.0
    for b in range(32):
        for n in range(8):
            seen = Transitions(*(c[b : b + 1, : batch.prefix[b, n]] for c in columns))
            logits = model.decide(torch.as_tensor(batch.queries[b : b + 1, n : n + 1]), model.encode(seen))
            slow -= float((torch.as_tensor(batch.labels[b, n]) * logits[0, 0].log_softmax(-1)).sum())
    assert batch_loss(model, batch).item() == pytest.approx(slow / 256, rel=1e-4)


def test_every_parameter_gets_a_gradient() -> None:
    model, pools = corridor()
    batch_loss(model, corridor_batch(pools, 0)).backward()
    without = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert without == []


@pytest.mark.integration
def test_a_fit_learns_the_corridor() -> None:
    """From log 2 = 0.69 to near the minimum: of the prefixes 0 to 8, only at 0 is the label uncertain."""
    model, pools = corridor()
    config = OptimConfig(learning_rate=1e-2, batch=32, queries=8, episodes=1, warmup=20)
    losses: list[tuple[int, float]] = []
    final = fit.fit(
        model,
        fit.Optimizer(model, config),
        config,
        config.learning_rate,
        200,
        lambda step: batch_loss(model, corridor_batch(pools, step)),
        lambda step, value: losses.append((step, value)),
    )
    minimum = math.log(2) / 9
    assert [step for step, _ in losses] == list(range(1, 201))
    assert losses[0][1] > 0.6
    assert minimum - 0.03 < final < minimum + 0.05
    assert final == pytest.approx(np.mean([value for _, value in losses[-20:]]))
    assert not model.training


def test_a_fit_stops_at_a_loss_that_is_nan() -> None:
    model, pools = corridor()
    config = OptimConfig(learning_rate=0.25)
    with torch.no_grad():
        model.head.bias.fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"nan at step 0: lower the learning rate \(0\.25\)"):
        fit.fit(
            model,
            fit.Optimizer(model, config),
            config,
            config.learning_rate,
            3,
            lambda step: batch_loss(model, corridor_batch(pools, step)),
        )


def test_the_learning_rate_rises_then_falls_to_a_tenth() -> None:
    values = [fit.rate(step, 110, 10) for step in range(110)]
    assert values[:10] == pytest.approx([0.1 * (i + 1) for i in range(10)])
    assert values[10] == 1.0
    assert values[60] == pytest.approx(0.55)
    assert all(a > b for a, b in itertools.pairwise(values[10:]))
    assert values[-1] == pytest.approx(0.1, abs=1e-3)
