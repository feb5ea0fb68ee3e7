"""Training time until a model is close to the exact posterior: ours and the official layout, on the same data.

The data distribution is DPT's: a 10x10 room without disturbance, one of 80 goals, a context of 100
transitions with uniform states and actions, a uniform query cell, and its optimal action as the label
(first y, then x: appendix C.1).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int

from icrl_dist.bench import peer
from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.models.heads import Categorical
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom.room import cells, next_cell
from icrl_dist.problems.darkroom.solver import Hypotheses, heuristic_labels, log_likelihood, posterior, posterior_action
from icrl_dist.training import fit
from icrl_dist.training.batches import Batch
from icrl_dist.types import NULL, Spec, Variation

SIZE, LENGTH, GOALS = 10, 100, 80
SPEC: Spec = darkroom.spec(darkroom.task((0, 0), SIZE, LENGTH))
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


@dataclass(frozen=True, eq=False)
class DPTContexts:
    """B contexts with N queries each."""

    goal: Int[np.ndarray, " B"]
    cell: Int[np.ndarray, "B T"]
    action: Int[np.ndarray, "B T"]
    arrived: Int[np.ndarray, "B T"]
    reward: Float32[np.ndarray, "B T"]
    query: Int[np.ndarray, "B N"]
    label: Float32[np.ndarray, "B N A"]

    def batch(self, prefix: Int[np.ndarray, "B N"]) -> Batch:
        """As a training batch of this project."""
        coordinates = cells(SIZE)
        states, arrived, queries = (coordinates[c] for c in (self.cell, self.arrived, self.query))
        return Batch(states, self.action, arrived, self.reward, queries, self.label, prefix)

    def tensors(self) -> tuple[Transitions, torch.Tensor, torch.Tensor]:
        """As a training batch of the peer: contexts, the first query of each, and its label."""
        batch = self.batch(np.zeros(self.query.shape, np.int64))
        columns = (batch.observations, batch.actions, batch.next_observations, batch.rewards)
        context = Transitions(*map(torch.from_numpy, columns))
        return context, torch.from_numpy(batch.queries[:, 0]), torch.from_numpy(batch.labels[:, 0])


class DPTData:
    """DPT's data distribution with the 80 goals of a seed."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        chosen = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,))).permutation(SIZE**2)[:GOALS]
        rooms = [darkroom.task(divmod(int(goal), SIZE), SIZE, LENGTH) for goal in chosen]
        self.hypotheses = Hypotheses.of([Variation(room, NULL) for room in rooms])
        self.labels = heuristic_labels(self.hypotheses)
        self._next = next_cell(SIZE)

    def draw(self, stream: int, step: int, batch: int, queries: int) -> DPTContexts:
        """Batch number ``step`` of a stream of batches; equal arguments give equal batches."""
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(1, stream, step)))
        index = rng.integers(0, GOALS, size=batch)
        goal = self.hypotheses.goal[index]
        cell = rng.integers(0, SIZE**2, size=(batch, LENGTH))
        action = rng.integers(0, SPEC.actions, size=(batch, LENGTH))
        query = rng.integers(0, SIZE**2, size=(batch, queries))
        arrived = self._next[cell, action]
        reward = (arrived == goal[:, None]).astype(np.float32)
        return DPTContexts(goal, cell, action, arrived, reward, query, self.labels[index[:, None], query])

    def floor(self, contexts: DPTContexts) -> float:
        """Cross-entropy of the exact posterior's decisions after 1 to T transitions, at the first query of each context."""
        prior = np.full(GOALS, -np.log(GOALS))
        total: list[Float64[np.ndarray, " T"]] = []
        for row, (query, label) in enumerate(zip(contexts.query[:, 0], contexts.label[:, 0], strict=True)):
            columns = (contexts.cell[row], contexts.action[row], contexts.reward[row], contexts.arrived[row])
            weights = posterior(prior, log_likelihood(self.hypotheses, *columns).cumsum(axis=0))
            probs = posterior_action(weights, self.labels, np.full(LENGTH, query))
            total.append(-np.log((probs * label).sum(axis=1)))
        return float(np.mean(total))


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


def ours(seed: int, report: Report = lambda text: None, steps: int = STEPS, close: float = CLOSE) -> dict[str, Any]:
    """Fit a ``PretrainedTransformer`` by ``training.fit`` until it reaches the target loss, for at most ``steps`` steps."""
    data, watch, curve = DPTData(seed), _Stopwatch(), []
    torch.manual_seed(seed)
    model = PretrainedTransformer(SPEC, MODEL)
    held_out = data.draw(1, 0, HELD_OUT, 1)
    floor = data.floor(held_out)

    def batch(step: int) -> Batch:
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

    optimizer = fit.Optimizer(model, OPTIM)
    watch.resume()
    try:
        fit.fit(model, optimizer, OPTIM, OPTIM.learning_rate, steps, batch, evaluate)
    except _TargetReached:
        return _outcome(True, curve, floor)
    return _outcome(False, curve, floor)


def theirs(
    seed: int, report: Report = lambda text: None, contexts: int = PEER_CONTEXTS, close: float = CLOSE
) -> dict[str, Any]:
    """Train the peer until it reaches the target loss, on at most ``contexts`` contexts."""
    data, watch, curve = DPTData(seed), _Stopwatch(), []
    torch.manual_seed(seed)
    model = peer.Peer(SPEC)
    optimizer = peer.optimizer(model)
    held_out = data.draw(1, 0, HELD_OUT, 1)
    floor, steps = data.floor(held_out), contexts // peer.BATCH
    for step in range(1, steps + 1):
        batch = data.draw(0, step, peer.BATCH, 1).tensors()
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
def _our_loss(model: PretrainedTransformer, held_out: DPTContexts) -> float:
    prefixes = np.tile(np.arange(1, LENGTH + 1), (len(held_out.goal), 1))
    total = 0.0
    for rows in np.array_split(np.arange(len(held_out.goal)), max(1, len(held_out.goal) // 32)):
        part = DPTContexts(**{k: v[rows] for k, v in vars(held_out).items()})
        wide = DPTContexts(**vars(part) | {"query": part.query.repeat(LENGTH, 1), "label": part.label.repeat(LENGTH, 1)})
        total += float(fit.batch_loss(model, wide.batch(prefixes[rows]))) * len(rows)
    return total / len(held_out.goal)


@torch.no_grad()
def _peer_loss(model: peer.Peer, held_out: DPTContexts) -> float:
    context, query, label = held_out.tensors()
    logits = model(context, query)[:, 1:]
    return float(Categorical(SPEC.actions).loss(logits, label[:, None].expand_as(logits)))
