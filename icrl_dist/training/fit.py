"""Supervised training: the optimizer, the learning-rate schedule and the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from icrl_dist.config.sections import OptimConfig
from icrl_dist.training import optimizers
from icrl_dist.training.optimizer_state import steps_of


class Optimizer:
    """AdamW of appendix B.2; with ``optim.muon``, Muon for the trunk's matrices and AdamW for the rest."""

    def __init__(self, model: nn.Module, config: OptimConfig) -> None:
        named = list(model.named_parameters())
        matrices = [p for name, p in named if config.muon and name.startswith("trunk.") and p.ndim == 2]
        others = [p for _, p in named if all(p is not matrix for matrix in matrices)]
        betas = (0.9, config.beta2)
        adamw = optimizers.AdamW(others, lr=config.learning_rate, weight_decay=config.weight_decay, betas=betas)
        self._parts: list[tuple[torch.optim.Optimizer, float]] = [(adamw, 1.0)]
        if matrices:
            self._parts.append((optimizers.Muon(matrices, weight_decay=0.0), config.muon))

    def step(self, learning_rate: float) -> None:
        """Update the weights with their gradients, and clear the gradients."""
        for part, factor in self._parts:
            for group in part.param_groups:
                group["lr"] = learning_rate * factor
            part.step()
            part.zero_grad(set_to_none=True)

    def state(self) -> dict[str, np.ndarray]:
        """The optimizer state (moments of the gradients) by name."""
        return {
            f"{number}/{index}/{name}": value.cpu().numpy()
            for number, (part, _) in enumerate(self._parts)
            for index, state in part.state_dict()["state"].items()
            for name, value in state.items()
        }

    def load(self, stored: Mapping[str, np.ndarray]) -> None:
        """The inverse of ``state``.  Raises ValueError for the state of another optimizer."""
        groups = [part.state_dict()["param_groups"] for part, _ in self._parts]
        shapes = [[tuple(p.shape) for group in part.param_groups for p in group["params"]] for part, _ in self._parts]
        steps_of(stored, shapes[0], shapes[1] if len(shapes) > 1 else [])
        states: dict[tuple[int, int], dict[str, Tensor]] = {}
        for key, value in stored.items():
            first, second, name = key.split("/")
            states.setdefault((int(first), int(second)), {})[name] = torch.from_numpy(np.array(value))
        for number, (part, _) in enumerate(self._parts):
            own = {index: state for (group, index), state in states.items() if group == number}
            part.load_state_dict({"state": own, "param_groups": groups[number]})


def rate(step: int, steps: int, warmup: int, cosine: Callable[[float], float] = math.cos) -> float:
    """Learning-rate factor: linear warmup, then cosine decay from 1 to 0.1."""
    if step < warmup:
        return (step + 1) / warmup
    done = (step - warmup) / max(1, steps - warmup)
    return 0.1 + 0.45 * (1 + cosine(math.pi * done))


def fit(
    model: nn.Module,
    opt: Optimizer,
    config: OptimConfig,
    learning_rate: float,
    steps: int,
    loss: Callable[[int], Tensor],
    progress: Callable[[int, float], None] = lambda step, value: None,
    first: int = 0,
) -> float:
    """Minimize a loss for ``steps`` steps at peak rate ``learning_rate``; ``loss(step)`` draws the data of a step.

    For the other arguments and the result see ``take_steps``.
    """

    def take(step: int, rate: float) -> float:
        value = loss(step)
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        opt.step(rate)
        return value.item()

    model.train()
    last = take_steps(take, config, learning_rate, steps, progress, first)
    model.eval()
    return last


def take_steps(
    take: Callable[[int, float], float],
    config: OptimConfig,
    learning_rate: float,
    steps: int,
    progress: Callable[[int, float], None] = lambda step, value: None,
    first: int = 0,
    cosine: Callable[[float], float] = math.cos,
) -> float:
    """Take the steps of a fit at peak rate ``learning_rate``; ``take(step, rate)`` takes one and returns its loss.

    A step depends only on its number, the weights and the optimizer state, so a fit that continues
    after ``first`` steps gives the same result as one without a stop.  Returns the mean loss of the
    last tenth of the steps.  Raises FloatingPointError if the loss is not finite.
    """
    warmup = min(config.warmup, max(1, steps // 10))
    total, counted = 0.0, 0
    for step in range(first, steps):
        current = take(step, learning_rate * rate(step, steps, warmup, cosine))
        if not math.isfinite(current):
            raise FloatingPointError(f"loss is {current} at step {step}: lower the learning rate ({learning_rate})")
        if step >= steps - max(1, steps // 10):
            total, counted = total + current, counted + 1
        progress(step + 1, current)
    return total / max(1, counted)
