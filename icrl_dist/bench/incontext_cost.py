"""The cost of a decision and of a label, ours and the peer's: the real deployment loop and the real training step."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from icrl_dist.bench import peer
from icrl_dist.bench.incontext_quality import LENGTH, MODEL, OPTIM, PROBLEM, kernel_of, pretraining_data, tensors
from icrl_dist.config.sections import ContextConfig
from icrl_dist.interfaces import Policy
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry
from icrl_dist.problems.benchmarks import PretrainingData
from icrl_dist.rollout.deployment import InContextPolicy
from icrl_dist.rollout.episode import episode
from icrl_dist.rollout.policies import RandomPolicy
from icrl_dist.training import fit
from icrl_dist.types import NULL, Variation

LENGTHS = tuple(range(0, 4001, 500))
"""Context lengths at which a decision is timed."""
ROWS = 20
"""Environments of these decisions."""


def matmul_gflops(size: int = 1024, repeats: int = 9, device: str = "cpu") -> float:
    """GFLOP/s of a product of two float32 matrices: the speed of this machine."""
    a = torch.ones(size, size, device=device)
    return 2e-9 * size**3 / statistics.median(_times(lambda: a @ a, repeats, device))


def deployment(batch: int, pairs: int) -> dict[str, list[float]]:
    """Environment steps per CPU-second of whole online episodes, each with a context of 100 transitions.

    Both sides run ``rollout.episode`` in the same environments and alternate.  The context is the previous
    episode, as in the official code.
    """
    rng = np.random.default_rng(0)
    part = registry.problem(PROBLEM).benchmarks
    assert part is not None
    env = registry.batch([Variation(row.task, NULL) for row in part.rows(rng, batch)])
    rngs = rng.spawn(batch)
    torch.manual_seed(0)
    ours = InContextPolicy(PretrainedTransformer(env.spec, MODEL).eval(), batch, ContextConfig(keep="last"))
    theirs = peer.PeerPolicy(peer.Peer(env.spec).eval())
    initial = episode(env, RandomPolicy(env.spec.actions), rngs)
    for policy in (ours, theirs):
        policy.append(
            initial.observations[:, :-1], initial.actions.astype(np.int64), initial.observations[:, 1:], initial.rewards
        )

    def rates(policy: Policy, episodes: int) -> list[float]:
        return [batch * LENGTH / seconds for seconds in _times(lambda: episode(env, policy, rngs), episodes)]

    rates(ours, 1)  # warms the caches
    measured: dict[str, list[float]] = {"ours": [], "peer": []}
    for _ in range(pairs):
        measured["ours"] += rates(ours, 4)
        measured["peer"] += rates(theirs, 1)
    return measured


def training(rounds: int) -> dict[str, float]:
    """Labelled queries per CPU-second through forward, backward and optimizer; both sides alternate."""
    data = pretraining_data(0)
    torch.manual_seed(0)
    step, labels = _our_step(data, OPTIM.batch)
    model = peer.Peer(data.spec)
    optimizer, batch = peer.optimizer(model), tensors(data.draw(0, 0, peer.BATCH, 1))
    ours, theirs = [], []
    for turn in range(rounds + 1):
        measured = _times(step, 8), _times(lambda: peer.train_step(model, optimizer, *batch), 5)
        if turn:  # the first one has cold caches
            ours += measured[0]
            theirs += measured[1]
    return {
        "labels_per_s": labels / statistics.median(ours),
        "peer_labels_per_s": peer.BATCH / statistics.median(theirs),
    }


def by_length(repeats: int = 25) -> dict[str, Any]:
    """CPU time of a decision in ``ROWS`` environments by context length, and exponents of its growth.

    ``length_exponent`` is the slope of log time against log length over all non-empty contexts,
    ``length_exponent_long`` over the longer half, which does not fit into the cache of every processor.
    """
    data = pretraining_data(0)
    torch.manual_seed(0)
    policy = InContextPolicy(PretrainedTransformer(data.spec, MODEL).eval(), ROWS, ContextConfig(max=max(LENGTHS)))
    state = np.zeros((ROWS, data.spec.observation), np.float32)
    microseconds: list[float] = []
    for number, length in enumerate(LENGTHS):
        while policy.length < length:
            contexts = data.draw(number, policy.length, ROWS, 1)
            batch = contexts.batch(np.zeros(contexts.query.shape, np.int64))
            policy.append(batch.observations, batch.actions, batch.next_observations, batch.rewards)
        policy.probabilities(state)
        microseconds.append(1e6 * statistics.median(_times(lambda: policy.probabilities(state), repeats)))
    slope = [float(np.polyfit(np.log(LENGTHS[first:]), np.log(microseconds[first:]), 1)[0]) for first in (1, len(LENGTHS) // 2)]
    return {
        "length": list(LENGTHS),
        "decision_us": [round(t) for t in microseconds],
        "length_exponent": round(slope[0], 3),
        "length_exponent_long": round(slope[1], 3),
    }


def on_device(device: str, batch: int = 1024, environments: int = 4096, size: int = 8192) -> dict[str, Any]:
    """Labels and decisions per second on an accelerator, and their shares of its limits.

    The limit of labels is the rate of a float32 product of two ``(size, size)`` matrices.  That of decisions
    is the rate of copying such a matrix, because a decision reads its context once per layer.  Both are
    measured here.
    """
    source = pretraining_data(0)
    torch.manual_seed(0)
    step, labels = _our_step(source, batch, device)
    step()
    with FlopCounterMode(display=False) as counter:
        step()
    label_s = statistics.median(_times(step, 9, device)) / labels
    model = PretrainedTransformer(source.spec, MODEL).to(device).eval()
    policy = InContextPolicy(model, environments, ContextConfig())
    data = source.draw(0, 0, environments, 1).batch(np.zeros((environments, 1), np.int64))
    policy.append(data.observations, data.actions, data.next_observations, data.rewards)
    state = data.queries[:, 0]
    policy.probabilities(state)
    decision_s = statistics.median(_times(lambda: policy.probabilities(state), 25, device)) / environments
    block = torch.ones(size, size, device=device)
    copied_per_s = 8 * size**2 / statistics.median(_times(block.clone, 9, device))
    return {
        "device": device,
        "labels_per_s": 1 / label_s,
        "labels_share": counter.get_total_flops() / labels / label_s / 1e9 / matmul_gflops(size, device=device),
        "decisions_per_s": 1 / decision_s,
        "decisions_share": 4 * MODEL.layers * MODEL.width * LENGTH / decision_s / copied_per_s,
    }


def _our_step(data: PretrainingData, batch: int, device: str | None = None) -> tuple[Callable[[], object], int]:
    """A training step on one drawn batch, and its number of labelled queries.

    ``device``: torch takes the step there; None: as a run takes it on the CPU.
    """
    model = PretrainedTransformer(data.spec, MODEL).to(device or "cpu").train()
    kernel, optimizer = None if device else kernel_of(model), fit.Optimizer(model, OPTIM)
    contexts = data.draw(0, 0, batch, OPTIM.queries)
    examples = contexts.batch(np.random.default_rng(0).integers(1, LENGTH + 1, size=contexts.query.shape))

    def step() -> None:
        if kernel is not None:
            kernel.step(examples, OPTIM.learning_rate)
            return
        loss = batch_loss(model, examples)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), OPTIM.clip)
        optimizer.step(OPTIM.learning_rate)

    return step, contexts.query.size


def _times(call: Callable[[], object], repeats: int, device: str = "cpu") -> list[float]:
    """Seconds of each call: CPU time, or wall time on another device."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    seconds = []
    for _ in range(repeats):
        began = clock()
        call()
        if device != "cpu":
            torch.cuda.synchronize()
        seconds.append(clock() - began)
    return seconds
