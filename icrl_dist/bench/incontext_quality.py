"""Training time until a model is close to the exact posterior: ours and the official layout, on the same data.

The data distribution is DPT's: a 10x10 room without disturbance, one of 80 goals, a context of 100
transitions with uniform states and actions, a uniform query cell, and its optimal action as the label
(first y, then x: appendix C.1).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from icrl_dist.bench import peer
from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.compiled import kinds
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.models.heads import Categorical
from icrl_dist.models.weights import share_weights, weights_of
from icrl_dist.problems import registry
from icrl_dist.problems.benchmarks import DrawnContexts, PretrainingData
from icrl_dist.training import fit, kernel_fit
from icrl_dist.training.batches import TrainingBatch

PROBLEM = "darkroom"
SIZE, LENGTH, GOALS = 10, 100, 80
CLOSE = 0.04
"""The target loss, in nats above the loss of the exact Bayes posterior (the floor)."""
MODEL = ModelConfig()
OPTIM = OptimConfig(learning_rate=4e-3, muon=5.0, beta2=0.98, batch=16, queries=100, warmup=30)
STEPS = 600
"""Steps of our fit, over which the learning rate decays."""
EVERY, PEER_EVERY = 20, 64
"""Steps between two evaluations of the held-out loss."""
PEER_CONTEXTS = 400_000
"""Contexts after which the peer is stopped; its time is then a lower bound."""
HELD_OUT = 1024
"""Contexts of the held-out loss."""


def pretraining_data(seed: int) -> PretrainingData:
    """DPT's data distribution with the 80 goals of a seed."""
    part = registry.problem(PROBLEM).benchmarks
    assert part is not None and part.pretraining is not None
    return part.pretraining(seed, SIZE, LENGTH, GOALS)


def tensors(contexts: DrawnContexts) -> tuple[Transitions, torch.Tensor, torch.Tensor]:
    """As a training batch of the peer: contexts, the first query of each, and its label."""
    batch = contexts.batch(np.zeros(contexts.query.shape, np.int64))
    columns = (batch.observations, batch.actions, batch.next_observations, batch.rewards)
    return (
        Transitions(*map(torch.from_numpy, columns)),
        torch.from_numpy(batch.queries[:, 0]),
        torch.from_numpy(batch.labels[:, 0]),
    )


class _TargetReached(Exception):  # noqa: N818
    """The held-out loss has reached the target."""


class _Stopwatch:
    """CPU time of training, without drawing data and evaluating the held-out loss."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.resume()

    def pause(self) -> None:
        self.seconds += time.process_time() - self._began

    def resume(self) -> None:
        self._began = time.process_time()


Report = Callable[[str], None]


def kernel_of(model: PretrainedTransformer) -> kernel_fit.KernelFit | None:
    """The fit of a run with ``learner.reproducible = "auto"``: by the kernel, which trains the weights of ``model``.

    None where there is no kernel; then torch trains it.
    """
    if not kinds("training"):
        return None
    found = kernel_fit.KernelFit(model.spec, MODEL, OPTIM, weights_of(model))
    share_weights(model, found.weights)
    return found


def ours(seed: int, report: Report = lambda text: None, steps: int = STEPS, close: float = CLOSE) -> dict[str, Any]:
    """Fit a ``PretrainedTransformer`` as a run does until it reaches the target loss, for at most ``steps`` steps."""
    data, watch, curve = pretraining_data(seed), _Stopwatch(), []
    torch.manual_seed(seed)
    model = PretrainedTransformer(data.spec, MODEL)
    held_out = data.draw(1, 0, HELD_OUT, 1)
    floor = data.floor(held_out)

    def batch_of(step: int) -> TrainingBatch:
        watch.pause()
        contexts = data.draw(0, step, OPTIM.batch, OPTIM.queries)
        prefix = np.random.default_rng((seed, step)).integers(1, LENGTH + 1, size=contexts.query.shape)
        examples = contexts.batch(prefix)
        watch.resume()
        return examples

    def evaluate(step: int, _: float) -> None:
        if step % EVERY and step < steps:
            return
        watch.pause()
        gap = _our_loss(model, held_out) - floor
        curve.append((round(watch.seconds, 2), round(gap, 4)))
        report(f"ours, seed {seed}: {step} steps, {watch.seconds:.0f} CPU-s, {gap:.3f} nats above the floor")
        if gap <= close:
            raise _TargetReached
        watch.resume()

    kernel, optimizer = kernel_of(model), fit.Optimizer(model, OPTIM)
    watch.resume()
    try:
        if kernel is None:
            loss_of = lambda step: batch_loss(model, batch_of(step))  # noqa: E731
            fit.fit(model, optimizer, OPTIM, OPTIM.learning_rate, steps, loss_of, evaluate)
        else:
            take = lambda step, rate: kernel.step(batch_of(step), rate)  # noqa: E731
            fit.take_steps(take, OPTIM, OPTIM.learning_rate, steps, evaluate, cosine=kernel_fit.cosine)
    except _TargetReached:
        return _outcome(True, curve, floor)
    return _outcome(False, curve, floor)


def theirs(
    seed: int, report: Report = lambda text: None, contexts: int = PEER_CONTEXTS, close: float = CLOSE
) -> dict[str, Any]:
    """Train the peer until it reaches the target loss, on at most ``contexts`` contexts."""
    data, watch, curve = pretraining_data(seed), _Stopwatch(), []
    torch.manual_seed(seed)
    model = peer.Peer(data.spec)
    optimizer = peer.optimizer(model)
    held_out = data.draw(1, 0, HELD_OUT, 1)
    floor, steps = data.floor(held_out), contexts // peer.BATCH
    for step in range(1, steps + 1):
        batch = tensors(data.draw(0, step, peer.BATCH, 1))
        watch.resume()
        peer.train_step(model, optimizer, *batch)
        watch.pause()
        if step % PEER_EVERY == 0 or step == steps:
            gap = _peer_loss(model, held_out) - floor
            curve.append((round(watch.seconds, 2), round(gap, 4)))
            report(
                f"peer, seed {seed}: {step * peer.BATCH:,} contexts, {watch.seconds:.0f} CPU-s, {gap:.3f} nats above the floor"
            )
            if gap <= close:
                return _outcome(True, curve, floor)
    return _outcome(False, curve, floor)


def _outcome(reached: bool, curve: list[tuple[float, float]], floor: float) -> dict[str, Any]:
    return {"reached": reached, "cpu_s": curve[-1][0], "floor": round(floor, 4), "curve": curve}


@torch.no_grad()
def _our_loss(model: PretrainedTransformer, held_out: DrawnContexts) -> float:
    count, total = len(held_out.query), 0.0
    whole = held_out.batch(np.ones(held_out.query.shape, np.int64))
    for rows in np.array_split(np.arange(count), max(1, count // 32)):
        prefixes = np.tile(np.arange(1, LENGTH + 1), (len(rows), 1))
        columns = {name: column[rows] for name, column in vars(whole).items() if column is not None}
        queries, labels = whole.queries[rows].repeat(LENGTH, 1), whole.labels[rows].repeat(LENGTH, 1)
        wide = replace(whole, **columns | {"queries": queries, "labels": labels, "prefix": prefixes})
        total += float(batch_loss(model, wide)) * len(rows)
    return total / count


@torch.no_grad()
def _peer_loss(model: peer.Peer, held_out: DrawnContexts) -> float:
    context, query, label = tensors(held_out)
    logits = model(context, query)[:, 1:]
    return float(Categorical(model.spec.actions).loss(logits, label[:, None].expand_as(logits)))
