"""How long until a model decides as the exact posterior does: ours and the official layout, on one law of data.

The law is DPT's: a 10x10 room without disturbance, a goal of 80, a context of 100 transitions
from states and actions drawn uniformly, a query cell drawn uniformly, and its optimal action
(first y, then x: appendix C.1) as the label, for both.
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
from icrl_dist.config.run import ModelConfig, OptimConfig
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
"""Nats above the exact Bayes floor at which a model is done."""
MODEL = ModelConfig()
OPTIM = OptimConfig(learning_rate=4e-3, muon=5.0, beta2=0.98, batch=16, queries=100, warmup=30)
STEPS = 600
"""Length of our fit, along which its rate falls."""
EVERY, PEER_EVERY = 20, 64
"""Steps between two looks at the held-out loss."""
PEER_CONTEXTS = 400_000
"""Contexts after which the peer is stopped: its time is then a lower bound."""
HELD_OUT = 1024


@dataclass(frozen=True, eq=False)
class Drawn:
    """B contexts of the law, with N queries each."""

    goal: Int[np.ndarray, " B"]
    cell: Int[np.ndarray, "B T"]
    action: Int[np.ndarray, "B T"]
    arrived: Int[np.ndarray, "B T"]
    reward: Float32[np.ndarray, "B T"]
    query: Int[np.ndarray, "B N"]
    label: Float32[np.ndarray, "B N A"]

    def batch(self, prefix: Int[np.ndarray, "B N"]) -> Batch:
        """As the project trains on it."""
        place = cells(SIZE)
        states, arrived, queries = (place[c] for c in (self.cell, self.arrived, self.query))
        return Batch(states, self.action, arrived, self.reward, queries, self.label, prefix)

    def tensors(self) -> tuple[Transitions, torch.Tensor, torch.Tensor]:
        """As the peer trains on it: contexts, the first query of each, its label."""
        whole = self.batch(np.zeros(self.query.shape, np.int64))
        columns = (whole.observations, whole.actions, whole.next_observations, whole.rewards)
        context = Transitions(*map(torch.from_numpy, columns))
        return context, torch.from_numpy(whole.queries[:, 0]), torch.from_numpy(whole.labels[:, 0])


class Law:
    """The goals of a seed, and draws from them."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        chosen = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,))).permutation(SIZE**2)[:GOALS]
        rooms = [darkroom.task(divmod(int(goal), SIZE), SIZE, LENGTH) for goal in chosen]
        self.hypotheses = Hypotheses.of([Variation(room, NULL) for room in rooms])
        self.labels = heuristic_labels(self.hypotheses)
        self._next = next_cell(SIZE)

    def draw(self, stream: int, step: int, batch: int, queries: int) -> Drawn:
        """Batch number ``step`` of a stream of batches, the same whenever it is drawn."""
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(1, stream, step)))
        which = rng.integers(0, GOALS, size=batch)
        goal = self.hypotheses.goal[which]
        cell = rng.integers(0, SIZE**2, size=(batch, LENGTH))
        action = rng.integers(0, SPEC.actions, size=(batch, LENGTH))
        query = rng.integers(0, SIZE**2, size=(batch, queries))
        arrived = self._next[cell, action]
        reward = (arrived == goal[:, None]).astype(np.float32)
        return Drawn(goal, cell, action, arrived, reward, query, self.labels[which[:, None], query])

    def floor(self, drawn: Drawn) -> float:
        """Cross-entropy of the exact posterior's decisions after 1 to T transitions, first query of each context."""
        prior = np.full(GOALS, -np.log(GOALS))
        total: list[Float64[np.ndarray, " T"]] = []
        for row, (query, label) in enumerate(zip(drawn.query[:, 0], drawn.label[:, 0], strict=True)):
            seen = (drawn.cell[row], drawn.action[row], drawn.reward[row], drawn.arrived[row])
            belief = posterior(prior, log_likelihood(self.hypotheses, *seen).cumsum(axis=0))
            law = posterior_action(belief, self.labels, np.full(LENGTH, query))
            total.append(-np.log((law * label).sum(axis=1)))
        return float(np.mean(total))


class _Enough(Exception):  # noqa: N818
    """The held-out loss is close enough."""


class _Watch:
    """CPU time of training, without the drawing of data and the looks at the held-out loss."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.go()

    def pause(self) -> None:
        self.seconds += time.process_time() - self._began

    def go(self) -> None:
        self._began = time.process_time()


Report = Callable[[str], None]


def ours(seed: int, report: Report = lambda text: None, steps: int = STEPS, close: float = CLOSE) -> dict[str, Any]:
    """Fit ``PretrainedTransformer`` by ``pretrain.fit`` until it is close to the floor, or for ``steps`` steps."""
    law, watch, curve = Law(seed), _Watch(), []
    torch.manual_seed(seed)
    model = PretrainedTransformer(SPEC, MODEL)
    held_out = law.draw(1, 0, HELD_OUT, 1)
    floor = law.floor(held_out)

    def batch(step: int) -> Batch:
        watch.pause()
        drawn = law.draw(0, step, OPTIM.batch, OPTIM.queries)
        prefix = np.random.default_rng((seed, step)).integers(1, LENGTH + 1, size=drawn.query.shape)
        made = drawn.batch(prefix)
        watch.go()
        return made

    def look(step: int, _: float) -> None:
        if step % EVERY and step < steps:
            return
        watch.pause()
        gap = _our_loss(model, held_out) - floor
        curve.append((round(watch.seconds, 2), round(gap, 4)))
        report(f"ours, seed {seed}: {step} steps, {watch.seconds:.0f} CPU-s, {gap:.3f} nats above the floor")
        if gap <= close:
            raise _Enough
        watch.go()

    opt = fit.Optimizer(model, OPTIM)
    watch.go()
    try:
        fit.fit(model, opt, OPTIM, OPTIM.learning_rate, steps, batch, look)
    except _Enough:
        return _outcome(True, curve, floor)
    return _outcome(False, curve, floor)


def theirs(
    seed: int, report: Report = lambda text: None, contexts: int = PEER_CONTEXTS, close: float = CLOSE
) -> dict[str, Any]:
    """Train the peer until it is close to the floor, or on so many contexts."""
    law, watch, curve = Law(seed), _Watch(), []
    torch.manual_seed(seed)
    model = peer.Peer(SPEC)
    opt = peer.optimizer(model)
    held_out = law.draw(1, 0, HELD_OUT, 1)
    floor, steps = law.floor(held_out), contexts // peer.BATCH
    for step in range(1, steps + 1):
        drawn = law.draw(0, step, peer.BATCH, 1).tensors()
        watch.go()
        peer.train_step(model, opt, *drawn)
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
def _our_loss(model: PretrainedTransformer, held_out: Drawn) -> float:
    every = np.tile(np.arange(1, LENGTH + 1), (len(held_out.goal), 1))
    total = 0.0
    for rows in np.array_split(np.arange(len(held_out.goal)), max(1, len(held_out.goal) // 32)):
        part = Drawn(**{k: v[rows] for k, v in vars(held_out).items()})
        wide = Drawn(**vars(part) | {"query": part.query.repeat(LENGTH, 1), "label": part.label.repeat(LENGTH, 1)})
        total += float(fit.batch_loss(model, wide.batch(every[rows]))) * len(rows)
    return total / len(held_out.goal)


@torch.no_grad()
def _peer_loss(model: peer.Peer, held_out: Drawn) -> float:
    context, query, label = held_out.tensors()
    logits = model(context, query)[:, 1:]
    return float(Categorical(SPEC.actions).loss(logits, label[:, None].expand_as(logits)))
