"""The benchmark of fits: its count of products, its step in parts, its ways, and its verdicts."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from icrl_dist.bench import fit as bench
from icrl_dist.bench import fit_ways
from icrl_dist.bench.fit_floor import step_flops
from icrl_dist.config.run import load_run
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.problems import registry
from icrl_dist.training import fit
from icrl_dist.training.batches import LabelledWindows, TrainingBatch
from tests.training.kernel_fits import Case

CASES = [Case(), Case(layers=1), Case(heads=2, layers=3, tokens=9, queries=40), Case(windows=3, window=4, fourier=2)]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_dense_products_are_those_that_torch_counts(case: Case) -> None:
    model, batch = case.model(), case.batch()
    # The counter does not know the fused attention of CPUs.
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        batch_loss(model, batch).backward()
    assert step_flops(model, batch, hidden=True) == counter.get_total_flops()


@pytest.mark.parametrize("case", CASES, ids=str)
def test_pairs_of_tokens_that_a_mask_hides_are_left_out(case: Case) -> None:
    model, batch = case.model(), case.batch()
    hidden = 0
    for row in range(case.contexts):
        for layer in range(case.layers):
            for token in range(case.tokens if layer + 1 < case.layers else 0):
                hidden += case.tokens - token - 1
            for prefix in batch.prefix[row]:
                hidden += case.tokens - int(prefix)
            for prefix in () if batch.window_prefix is None else batch.window_prefix[row]:
                for state in range(case.window):
                    hidden += case.tokens - int(prefix) + case.window - state - 1
    multiplied = 2 * case.width  # by each pair: a score and a value
    forward_and_backward = 2 * 3
    dense, least = step_flops(model, batch, hidden=True), step_flops(model, batch)
    assert hidden > 0 and dense - least == forward_and_backward * multiplied * hidden


@pytest.mark.parametrize("name", ["smoke", "darkroom"])
def test_the_timed_parts_are_the_step_of_a_fit(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    run, batches = _run_of_one_batch(name)
    parts = fit_ways.PartsOfTorch(run, lambda rng: batches)
    model = fit_ways.new_model(run)
    optimizer = fit.Optimizer(model, run.optim)
    monkeypatch.setattr(fit, "rate", lambda step, steps, warmup, cosine: 1.0)
    found = [parts.step(number) for number in range(3)]
    fit.fit(model, optimizer, run.optim, fit_ways.RATE, 3, lambda step: batch_loss(model, batches))
    for (key, one), other in zip(model.named_parameters(), parts.model.parameters(), strict=True):
        assert torch.equal(one, other), key
    assert next(iter(found[0])) == "draw" and ("windows" in found[0]) == (batches.windows is not None)
    assert all(part.wall_ms >= 0 and part.cpu_ms >= 0 for step in found for part in step.values())


def _run_of_one_batch(name: str) -> tuple[Any, TrainingBatch]:
    """A run, with action windows if it is ``darkroom``, and a batch for it."""
    run = load_run(name, *(("model.window=3", "optim.windows=2", "pretrain.windows=2") if name == "darkroom" else ()))
    rng, actions = np.random.default_rng(0), registry.of(run).spec.actions

    def states(*shape: int) -> np.ndarray:
        return rng.integers(0, 5, size=(*shape, 2)).astype(np.float32)

    def labels(*shape: int) -> np.ndarray:
        return np.eye(actions, dtype=np.float32)[rng.integers(0, actions, size=shape)]

    windows = None
    if run.model.window > 1:
        taken = rng.integers(0, actions, size=(2, 2, 3))
        windows = LabelledWindows(states(2, 2, 3), taken, np.ones((2, 2, 3), np.float32), labels(2, 2, 3))
    taken, rewards = rng.integers(0, actions, size=(2, 6)), rng.integers(0, 2, size=(2, 6)).astype(np.float32)
    prefix, window_prefix = rng.integers(0, 7, size=(2, 4)), None if windows is None else rng.integers(0, 7, size=(2, 2))
    context = states(2, 6), taken, states(2, 6), rewards
    return run, TrainingBatch(*context, states(2, 4), labels(2, 4), prefix, windows, window_prefix)


@pytest.mark.integration
def test_it_measures_every_way_with_the_same_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, list[int]] = {}

    def way(name: str, seconds: float) -> Any:
        def make(run: Any, draw: Any, threads: int) -> fit_ways.Steps:
            def steps(first: int, count: int) -> None:
                drawn.setdefault(f"{name} {threads}", []).extend(range(first, first + count))
                fit_ways.batch_of(run, draw, first)
                deadline = time.process_time() + seconds * count
                while time.process_time() < deadline:
                    pass

            return steps

        return make

    monkeypatch.setattr(fit_ways, "ways", lambda run: {"torch": way("torch", 0.02), "fast": way("fast", 0.005)})
    result = bench.run(quick=True, runs=("smoke",))
    assert json.loads(json.dumps(result)) == result
    assert len(drawn) == 2 * len(result["fits"]) and len(set(map(tuple, drawn.values()))) == 1
    for row, ratio in zip(result["fits"], result["fit_over_torch"], strict=True):
        assert ratio > 1 and row["ways"]["fast"]["cpu_ms"] < row["ways"]["torch"]["cpu_ms"]
        assert 0 < row["floor_ms"] < row["dense_floor_ms"] and row["step_over_floor"] < row["torch_over_floor"]
    text = bench.describe(result)
    assert max(map(len, text.splitlines())) <= 80
    assert "smoke, 1 thread" in text and "optimizer" in text and f"{result['fit_over_torch'][0]:.2f}" in text


def test_a_missed_bound_is_a_reason() -> None:
    row = {"run": "demo", "threads": 2, "ways": {"torch": {}, "kernel": {}}, "fit_over_torch": 1.5, "step_over_floor": 2.0}
    assert not bench._missed(row)
    assert bench._missed(row | {"fit_over_torch": 1.4}) == ["demo, 2 threads: 1.40 steps per step of torch, below 1.5"]
    assert bench._missed(row | {"step_over_floor": 2.1}) == ["demo, 2 threads: a step takes 2.10 times its floor, above 2"]


def test_without_the_kernel_nothing_is_compared() -> None:
    way = {"torch": {"steps_per_s": 10.0, "cpu_ms": 60.0}}
    numbers = {"fit_over_torch": 1.0, "step_over_floor": 3.9, "floor_ms": 15.0, "dense_floor_ms": 20.0, "parts": {}}
    row = {"run": "demo", "threads": 2, "ways": way} | numbers
    assert not bench._missed(row), "torch is no worse than itself"
    text = bench.describe({"fits": [row], "reasons": []})
    assert "icrl-dist doctor" in text and max(map(len, text.splitlines())) <= 80
