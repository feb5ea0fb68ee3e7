"""A fit by the training kernel: the same weights on every processor and with any number of threads.

The kernel (``models.training_kernel``) computes every sum; numpy computes the rest, number by number.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
from jaxtyping import Float32

from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.copies import NotCopied
from icrl_dist.models.features import Features
from icrl_dist.models.training_kernel import Contexts, Inputs, TrainingKernel
from icrl_dist.training.batches import TrainingBatch
from icrl_dist.training.optimizer_state import steps_of
from icrl_dist.types import Spec

_GROUPS = 16
"""Gradients of contexts are summed in at most so many groups, and these in order, whatever the number of threads."""
_BETA1, _EPS = 0.9, 1e-8
_MOMENTUM = 0.95
_NEWTON_SCHULZ = (3.4445, -4.775, 2.0315)


class KernelFit(NotCopied):
    """A model and its optimizer, trained by the loss of ``methods.dpt_loss`` on batches of ``training.batches``.

    The optimizer is that of ``training.fit.Optimizer``, with its state under the same names; Muon computes in float32
    where torch's computes in bfloat16.
    """

    instead = "it holds threads and a compiled library; make a new one from its weights and its state"

    def __init__(
        self,
        spec: Spec,
        config: ModelConfig,
        optim: OptimConfig,
        weights: Mapping[str, np.ndarray],
        threads: int = 1,
        kind: str | None = None,
    ) -> None:
        """``weights``: those to begin with, by name, in the order of the model's parameters; ``kind``: see ``TrainingKernel``.

        Raises RuntimeError if the kernel was not built or cannot be used here.
        """
        self._matrices = [name for name in weights if optim.muon and name.startswith("trunk.") and weights[name].ndim == 2]
        self._others = [name for name in weights if name not in self._matrices]
        self._shapes = {name: weights[name].shape for name in (*self._others, *self._matrices)}
        self._kernel = TrainingKernel(spec, config, self._shapes, kind)
        self._parameters = np.concatenate([np.ravel(weights[name]) for name in self._shapes]).astype(np.float32)
        self._adamw = sum(weights[name].size for name in self._others)
        """Numbers that AdamW trains: those before the matrices of Muon."""
        self._first, self._second = np.zeros_like(self._parameters), np.zeros(self._adamw, np.float32)
        self._steps = 0
        views = self._views(self._parameters)
        self.weights = {name: views[name] for name in weights}
        """The parameters: views, which change with every step, and may be written to."""
        self._features, self._optim, self._spec = Features(spec, config.fourier), optim, spec
        self._pool = ThreadPoolExecutor(threads, "fit")
        self._work = [np.empty(0, np.float32) for _ in range(threads)]
        self._parts = np.empty((0, self._kernel.gradient_size), np.float32)

    def _views(self, flat: Float32[np.ndarray, " P"]) -> dict[str, np.ndarray]:
        """The parts of an array with a number for each parameter, by name; it may end before the matrices of Muon."""
        found, end = {}, 0
        for name, shape in self._shapes.items():
            begin, end = end, end + math.prod(shape)
            if end <= len(flat):
                found[name] = flat[begin:end].reshape(shape)
        return found

    def step(self, batch: TrainingBatch, learning_rate: float) -> float:
        """Update the weights by the gradient of one batch; returns its loss before the update."""
        with np.errstate(all="ignore"):  # as torch: the loss is not finite then
            return self._step(batch, learning_rate)

    def _step(self, batch: TrainingBatch, learning_rate: float) -> float:
        loss, gradient = self._gradient(batch)
        norm = self._kernel.norm(gradient)
        gradient *= np.float32(min(1.0, self._optim.clip / (norm + 1e-6)))
        self._steps += 1
        self._step_adamw(gradient[: self._adamw], learning_rate)
        if self._matrices:
            self._step_muon(self._views(gradient), learning_rate * self._optim.muon)
        return loss

    def gradient(self, batch: TrainingBatch) -> tuple[float, dict[str, np.ndarray]]:
        """The loss of a batch and its gradient, by parameter."""
        loss, gradient = self._gradient(batch)
        return loss, self._views(gradient)

    def _gradient(self, batch: TrainingBatch) -> tuple[float, Float32[np.ndarray, " P"]]:
        self._kernel.load(self._parameters)
        contexts, count = Contexts(self._kernel, self._inputs(batch)), len(batch.prefix)
        groups = min(_GROUPS, count)
        if len(self._parts) < groups:
            self._parts = np.empty((groups, self._kernel.gradient_size), np.float32)
        losses, turns = np.empty(count), itertools.count()

        def work(thread: int) -> None:
            if len(self._work[thread]) < contexts.work_size:
                self._work[thread] = np.empty(contexts.work_size, np.float32)
            while (group := next(turns)) < groups:
                self._parts[group] = 0
                for context in range(group, count, groups):
                    losses[context] = contexts.add(context, self._parts[group], self._work[thread])

        others = [self._pool.submit(work, thread) for thread in range(1, len(self._work))]
        try:
            work(0)
        finally:
            wait(others)  # also after an error: they write where the next step does
        for other in others:
            other.result()
        total = math.fsum(losses) if np.isfinite(losses).all() else float(losses.sum())  # fsum refuses inf - inf
        return total / contexts.labels, self._kernel.gradient(self._parts[:groups])

    def _inputs(self, batch: TrainingBatch) -> Inputs:
        """A batch as the kernel takes it: with the queries of each context in the order of their prefixes."""
        features, actions = self._features.observations, self._features.actions
        columns = batch.observations, batch.actions, batch.next_observations, batch.rewards
        tokens = _with_one(self._features.transitions(*columns))
        order = np.argsort(batch.prefix, axis=1, kind="stable")
        queries = _with_one(features(np.take_along_axis(batch.queries, order[..., None], 1)))
        labels = np.take_along_axis(batch.labels, order[..., None], 1)
        prefix, own = np.take_along_axis(batch.prefix, order, 1), np.ones(order.shape[1], np.int32)
        if batch.windows is not None:
            assert batch.window_prefix is not None
            order = np.argsort(batch.window_prefix, axis=1, kind="stable")
            states, taken, rewards, window_labels = (
                np.take_along_axis(c, order.reshape(*order.shape, *[1] * (c.ndim - 2)), 1) for c in batch.windows
            )
            states = features(states)
            # Each state, and the previous state of the window with its action and reward; the first has no previous one.
            before = np.concatenate([states, actions(taken), rewards[..., None]], axis=-1, dtype=np.float32)
            before = np.pad(_with_one(before)[..., :-1, :], ((0, 0), (0, 0), (1, 0), (0, 0)))
            rows, length = len(order), states.shape[2]
            windows = np.concatenate([_with_one(states), before], axis=-1).reshape(rows, -1, queries.shape[2] + before.shape[3])
            queries = np.pad(queries, ((0, 0), (0, 0), (0, before.shape[3])))
            queries = np.concatenate([queries, windows], axis=1)
            labels = np.concatenate([labels, window_labels.reshape(rows, -1, labels.shape[2])], axis=1)
            window_prefix = np.repeat(np.take_along_axis(batch.window_prefix, order, 1), length, axis=1)
            prefix = np.concatenate([prefix, window_prefix], axis=1)
            own = np.concatenate([own, np.tile(np.arange(1, length + 1, dtype=np.int32), states.shape[1])])
        return Inputs(tokens, queries, labels, prefix.max(axis=1).astype(np.int32), prefix.astype(np.int32), own)

    def _step_adamw(self, gradient: Float32[np.ndarray, " A"], rate: float) -> None:
        """AdamW as torch's: decay of the weights, then a step of Adam."""
        p, m, v = self._parameters[: self._adamw], self._first[: self._adamw], self._second
        beta2 = self._optim.beta2
        p *= np.float32(1 - rate * self._optim.weight_decay)
        m += (gradient - m) * np.float32(1 - _BETA1)
        v *= np.float32(beta2)
        v += gradient * gradient * np.float32(1 - beta2)
        size = np.float32(rate / (1 - _power(_BETA1, self._steps)))
        spread = np.sqrt(v) / np.float32(math.sqrt(1 - _power(beta2, self._steps))) + np.float32(_EPS)
        p -= size * (m / spread)

    def _step_muon(self, gradients: Mapping[str, np.ndarray], rate: float) -> None:
        """Muon as torch's, without weight decay: the momentum made orthogonal."""
        momenta, weights = self._views(self._first), self._views(self._parameters)
        for name in self._matrices:
            gradient, momentum = gradients[name], momenta[name]
            momentum += (gradient - momentum) * np.float32(1 - _MOMENTUM)
            update = gradient + (momentum - gradient) * np.float32(_MOMENTUM)
            update /= np.float32(max(self._kernel.norm(update.ravel()), 1e-7))
            factor = rate * math.sqrt(max(1.0, update.shape[0] / update.shape[1]))
            weights[name] -= np.float32(factor) * self._kernel.orthogonal(update, *_NEWTON_SCHULZ)

    def state(self) -> dict[str, np.ndarray]:
        """The state of the optimizer, as ``training.fit.Optimizer.state``; empty before the first step."""
        if not self._steps:
            return {}
        first, second = self._views(self._first), self._views(self._second)
        found = {f"1/{index}/momentum_buffer": first[name].copy() for index, name in enumerate(self._matrices)}
        for index, name in enumerate(self._others):
            found[f"0/{index}/step"] = np.array(self._steps, np.float32)
            found |= {f"0/{index}/exp_avg": first[name].copy(), f"0/{index}/exp_avg_sq": second[name].copy()}
        return found

    def load(self, stored: Mapping[str, np.ndarray]) -> None:
        """The inverse of ``state``.  Raises ValueError for the state of another optimizer."""
        steps = steps_of(stored, *([self._shapes[name] for name in names] for names in (self._others, self._matrices)))
        if len(steps) > 1:
            raise ValueError(f"its parameters took {min(steps)} to {max(steps)} steps, not the same number")
        self._steps = steps.pop() if steps else 0
        self._first[:], self._second[:] = 0, 0
        first, second = self._views(self._first), self._views(self._second)
        for index, name in enumerate(self._matrices if stored else ()):
            first[name][...] = stored[f"1/{index}/momentum_buffer"]
        for index, name in enumerate(self._others if stored else ()):
            first[name][...], second[name][...] = stored[f"0/{index}/exp_avg"], stored[f"0/{index}/exp_avg_sq"]


def _with_one(x: Float32[np.ndarray, "*N I"]) -> Float32[np.ndarray, "*N J"]:
    """The rows with a 1 at their ends, by which the bias is multiplied."""
    return np.concatenate([x, np.ones((*x.shape[:-1], 1), np.float32)], axis=-1)


def cosine(x: float) -> float:
    """The cosine for 0 <= x <= pi, by additions and multiplications alone, to 1e-14: see ``_power``."""
    total = 0.0
    for power in range(30, 0, -2):
        total = (1 + total) * (x * x) * (-1 / (power * (power - 1)))
    return 1 + total


def _power(base: float, exponent: int) -> float:
    """``base ** exponent`` by multiplications alone: the power of a mathematical library depends on the library."""
    result = 1.0
    while exponent:
        result, base, exponent = result * base if exponent % 2 else result, base * base, exponent // 2
    return result
