"""Supervised pretraining: the loss of eq. (1), one step, and a fit."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from icrl_dist.config import OptimConfig
from icrl_dist.context import Batch
from icrl_dist.models.dpt import PretrainedTransformer, Transitions


def loss(logits: Float[Tensor, "*B A"], labels: Float[Tensor, "*B A"]) -> Float[Tensor, ""]:
    """-log T_theta(a* | s_query, D) of eq. (1), in nats, averaged; a* may be a distribution."""
    return -(labels * logits.log_softmax(dim=-1)).sum(dim=-1).mean()


def batch_loss(model: PretrainedTransformer, batch: Batch) -> Float[Tensor, ""]:
    """Eq. (1) over every (prefix, query) pair of a batch."""
    device = model.low.device

    def put(array: object) -> Tensor:
        return torch.as_tensor(array, device=device)

    context = Transitions(*map(put, (batch.observations, batch.actions, batch.next_observations, batch.rewards)))
    return loss(model(context, put(batch.queries), put(batch.prefix)), put(batch.labels))


def optimiser(model: PretrainedTransformer, config: OptimConfig) -> torch.optim.AdamW:
    """AdamW of appendix B.2."""
    betas = (0.9, config.beta2)
    return torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, betas=betas)


def rate(step: int, steps: int, warmup: int) -> float:
    """Learning-rate factor: a linear rise, then a cosine from 1 to a tenth."""
    if step < warmup:
        return (step + 1) / warmup
    done = (step - warmup) / max(1, steps - warmup)
    return 0.1 + 0.45 * (1 + math.cos(math.pi * done))


def fit(
    model: PretrainedTransformer,
    opt: torch.optim.Optimizer,
    config: OptimConfig,
    learning_rate: float,
    steps: int,
    batch: Callable[[int], Batch],
    progress: Callable[[int, float], None] = lambda step, value: None,
    first: int = 0,
) -> float:
    """Minimise eq. (1) for ``steps`` steps at peak rate ``learning_rate``; ``batch(step)`` draws the data.

    A step depends on its number, the weights and the optimiser alone, so a fit stopped after
    ``first`` steps goes on as if it had never stopped.  Returns the mean loss of the last
    tenth.  Raises FloatingPointError if the loss stops being a number.
    """
    model.train()
    warmup = min(config.warmup, max(1, steps // 10))
    total, counted = 0.0, 0
    for step in range(first, steps):
        for group in opt.param_groups:
            group["lr"] = learning_rate * rate(step, steps, warmup)
        value = batch_loss(model, batch(step))
        opt.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        opt.step()
        current = value.item()
        if not math.isfinite(current):
            raise FloatingPointError(f"loss is {current} at step {step}: lower the learning rate ({learning_rate})")
        if step >= steps - max(1, steps // 10):
            total, counted = total + current, counted + 1
        progress(step + 1, current)
    model.eval()
    return total / max(1, counted)
