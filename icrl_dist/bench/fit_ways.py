"""The ways to take a training step that ``bench fit`` compares, and the parts of a step by torch."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import torch

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer, Transitions, Windows
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.training import fit, kernel_fit, reproducible
from icrl_dist.training.batches import TrainingBatch
from icrl_dist.training.kernel_fit import KernelFit

RATE = 1e-4
"""Learning rate of all steps: the cost of a step does not depend on it."""

Steps = Callable[[int, int], None]
"""``steps(first, count)``: draws the batches of these steps and takes the steps, as the fit of a run does."""


def batch_of(run: Run, draw: Draw, step: int) -> TrainingBatch:
    """The batch of a step of T^0."""
    drawn: TrainingBatch = draw(generator(run.seed, RandomKey.FIT, 0, step))
    return drawn


def new_model(run: Run) -> PretrainedTransformer:
    """An untrained model of the run, the same in every call."""
    torch.manual_seed(run.seed)
    model = methods.of(run).build(registry.of(run).spec, run)
    assert isinstance(model, PretrainedTransformer)
    return model


def _by_torch(run: Run, draw: Draw, threads: int) -> Steps:
    """``training.fit`` with the loss of the run's method; ``threads`` are those of torch already."""
    method, model = methods.of(run), new_model(run)
    optimizer = fit.Optimizer(model, run.optim)

    def steps(first: int, count: int) -> None:
        fit.fit(
            model,
            optimizer,
            run.optim,
            RATE,
            first + count,
            lambda step: method.loss(model, batch_of(run, draw, step)),
            first=first,
        )

    return steps


def _by_kernel(run: Run, draw: Draw, threads: int) -> Steps:
    """``training.kernel_fit``: everything but the batches in a compiled kernel."""
    kernel = KernelFit(registry.of(run).spec, run.model, run.optim, weights_of(new_model(run)), threads)

    def steps(first: int, count: int) -> None:
        take = lambda step, rate: kernel.step(batch_of(run, draw, step), rate)  # noqa: E731
        fit.take_steps(take, run.optim, RATE, first + count, first=first, cosine=kernel_fit.cosine)

    return steps


def ways(run: Run) -> dict[str, Callable[[Run, Draw, int], Steps]]:
    """By name ``make(run, draw, threads)``: torch first, and last the way that the run takes on this CPU."""
    by_kernel = reproducible.best_fit(run) == "any-machine"
    return {"torch": _by_torch, **({"kernel": _by_kernel} if by_kernel else {})}


class Part(NamedTuple):
    """The time of one part of a step, in milliseconds."""

    wall_ms: float
    cpu_ms: float


class PartsOfTorch:
    """A step by torch in parts, each of them timed: the computation of ``methods.dpt_loss`` and ``training.fit``."""

    def __init__(self, run: Run, draw: Draw) -> None:
        self._run, self._draw = run, draw
        self.model = new_model(run).train()
        self._optimizer = fit.Optimizer(self.model, run.optim)

    def step(self, number: int) -> dict[str, Part]:
        """Take one step; returns the time of each part, in the order of the parts."""
        model, parts = self.model, dict[str, Part]()
        began = time.perf_counter(), time.process_time()

        def ended(name: str) -> None:
            nonlocal began
            now = time.perf_counter(), time.process_time()
            parts[name] = Part(1e3 * (now[0] - began[0]), 1e3 * (now[1] - began[1]))
            began = now

        batch = batch_of(self._run, self._draw, number)
        ended("draw")
        put = torch.as_tensor
        context = Transitions(*map(put, (batch.observations, batch.actions, batch.next_observations, batch.rewards)))
        queries, prefix, labels = map(put, (batch.queries, batch.prefix, batch.labels))
        ended("tensors")
        cache = model.encode(context)
        ended("contexts")
        outputs = model.decide(queries, cache, prefix)
        ended("queries")
        loss = model.action_head.loss(outputs, labels)
        if batch.windows is not None:
            states, taken, rewards, window_labels = map(put, batch.windows)
            found = model.decide_windows(Windows(states, taken, rewards), cache, put(batch.window_prefix))
            ended("windows")
            count = states.shape[1] * states.shape[2]
            share = count / (count + prefix.shape[1])
            loss = (1 - share) * loss + share * model.action_head.loss(found, window_labels)
        ended("loss")
        loss.backward()  # type: ignore[no-untyped-call]
        ended("backward")
        torch.nn.utils.clip_grad_norm_(model.parameters(), self._run.optim.clip)
        ended("clip")
        self._optimizer.step(RATE)
        ended("optimizer")
        return parts
