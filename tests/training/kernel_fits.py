"""Models and batches of many shapes, for the tests of the fit through the kernel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import weights_of
from icrl_dist.training.batches import LabelledWindows, TrainingBatch
from icrl_dist.training.kernel_fit import KernelFit
from icrl_dist.types import Spec


class Case(NamedTuple):
    """The shape of a model and of a batch."""

    contexts: int = 3
    tokens: int = 21
    queries: int = 5
    windows: int = 0
    layers: int = 2
    heads: int = 1
    width: int = 32
    window: int = 1
    fourier: int = 0
    discrete: bool = True
    actions: int = 5

    @property
    def spec(self) -> Spec:
        return Spec(low=(0.0, -1.0, 2.0), high=(4.0, 1.0, 7.0), actions=self.actions, horizon=7, discrete=self.discrete)

    @property
    def config(self) -> ModelConfig:
        return ModelConfig(self.layers, self.heads, self.width, self.fourier, self.window)

    def model(self, scale: float = 0.3) -> PretrainedTransformer:
        """A model in which every parameter has an effect."""
        torch.manual_seed(1)
        model = PretrainedTransformer(self.spec, self.config)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(torch.randn_like(parameter) * scale)
        return model

    def fit(self, model: PretrainedTransformer, threads: int = 1, kind: str | None = None, **optim: float) -> KernelFit:
        settings = OptimConfig(**optim)  # type: ignore[arg-type]
        return KernelFit(self.spec, self.config, settings, weights_of(model), threads, kind)

    def batch(self, seed: int = 0) -> TrainingBatch:
        """Random contexts, padded at their ends, with prefixes of 0 and of all transitions among others."""
        rng = np.random.default_rng(seed)
        b, t, n, r, length = self.contexts, self.tokens, self.queries, self.windows, self.window
        lengths = rng.integers((t + 1) // 2, t + 1, size=b)
        lengths[0] = t

        def states(*shape: int) -> np.ndarray:
            return rng.uniform((0, -1, 2), (4, 1, 7), size=(*shape, 3)).astype(np.float32)

        def actions(*shape: int) -> np.ndarray:
            if self.discrete:
                return rng.integers(0, self.actions, size=shape)
            return rng.uniform(-1, 1, size=(*shape, self.actions)).astype(np.float32)

        def labels(*shape: int) -> np.ndarray:
            if not self.discrete:
                return rng.uniform(-1, 1, size=(*shape, self.actions)).astype(np.float32)
            weights = rng.integers(0, 4, size=(*shape, self.actions)).astype(np.float32) + np.float32(0.25)
            return weights / weights.sum(axis=-1, keepdims=True)

        def prefix(count: int) -> np.ndarray:
            found = rng.integers(0, lengths[:, None] + 1, size=(b, count))
            found[:, 0] = 0
            found[:, -1] = lengths
            return found

        before, taken, after, rewards = states(b, t), actions(b, t), states(b, t), rng.uniform(0, 1, (b, t)).astype(np.float32)
        for column in (before, taken, after, rewards):
            for row, end in enumerate(lengths):
                column[row, end:] = 0
        made = None
        if r:
            earned = rng.uniform(0, 1, size=(b, r, length)).astype(np.float32)
            made = LabelledWindows(states(b, r, length), actions(b, r, length), earned, labels(b, r, length))
        queries = states(b, n), labels(b, n), prefix(n)
        return TrainingBatch(before, taken, after, rewards, *queries, made, prefix(r) if r else None)


def by_torch(model: PretrainedTransformer, batch: TrainingBatch) -> tuple[float, dict[str, Tensor]]:
    """The loss of torch and its gradients."""
    model.zero_grad()
    loss = batch_loss(model, batch)
    loss.backward()
    return loss.item(), {name: parameter.grad for name, parameter in model.named_parameters() if parameter.grad is not None}
