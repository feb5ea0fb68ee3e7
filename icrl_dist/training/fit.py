"""Supervised pretraining: the loss of eq. (1), one step, and a fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from icrl_dist.config.run import OptimConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions, Windows
from icrl_dist.training import optimizers
from icrl_dist.training.batches import Batch


def batch_loss(model: PretrainedTransformer, batch: Batch) -> Float[Tensor, ""]:
    """Eq. (1) over every (prefix, query) pair of a batch, and with windows eq. (6), every label counting the same."""
    device = model.low.device

    def put(array: object) -> Tensor:
        return torch.as_tensor(array, device=device)

    context = Transitions(*map(put, (batch.observations, batch.actions, batch.next_observations, batch.rewards)))
    cache = model.encode(context)
    total = model.action_head.loss(model.decide(put(batch.queries), cache, put(batch.prefix)), put(batch.labels))
    if batch.windows is not None:
        states, taken, gained, labels = batch.windows
        followed = model.decide_windows(Windows(put(states), put(taken), put(gained)), cache, put(batch.window_prefix))
        count = states.shape[1] * states.shape[2]
        share = count / (count + batch.prefix.shape[1])
        total = (1 - share) * total + share * model.action_head.loss(followed, put(labels))
    return total


class Optimizer:
    """AdamW of appendix B.2; with ``optim.muon``, Muon for the trunk's matrices and AdamW for the rest."""

    def __init__(self, model: PretrainedTransformer, config: OptimConfig) -> None:
        named = list(model.named_parameters())
        matrices = [p for name, p in named if config.muon and name.startswith("trunk.") and p.ndim == 2]
        others = [p for _, p in named if all(p is not matrix for matrix in matrices)]
        betas = (0.9, config.beta2)
        adamw = optimizers.AdamW(others, lr=config.learning_rate, weight_decay=config.weight_decay, betas=betas)
        self._parts: list[tuple[torch.optim.Optimizer, float]] = [(adamw, 1.0)]
        if matrices:
            self._parts.append((optimizers.Muon(matrices, weight_decay=0.0), config.muon))

    def step(self, learning_rate: float) -> None:
        """Change the weights by their gradients, and forget those."""
        for part, factor in self._parts:
            for group in part.param_groups:
                group["lr"] = learning_rate * factor
            part.step()
            part.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Tensor]:
        """What it remembers of earlier gradients, by name."""
        return {
            f"{number}/{index}/{name}": value
            for number, (part, _) in enumerate(self._parts)
            for index, state in part.state_dict()["state"].items()
            for name, value in state.items()
        }

    def load(self, remembered: Mapping[str, Tensor]) -> None:
        """The inverse of ``state``.  Raises ValueError for another optimizer's."""
        groups = [part.state_dict()["param_groups"] for part, _ in self._parts]
        places = {(number, index) for number, (group,) in enumerate(groups) for index in group["params"]}
        states: dict[tuple[int, int], dict[str, Tensor]] = {}
        for key, value in remembered.items():
            first, second, name = key.split("/")
            states.setdefault((int(first), int(second)), {})[name] = value
        if states and set(states) != places:
            raise ValueError(f"it remembers {len(states)} parameters in other places than these {len(places)}")
        for number, (part, _) in enumerate(self._parts):
            own = {index: state for (of, index), state in states.items() if of == number}
            part.load_state_dict({"state": own, "param_groups": groups[number]})


def rate(step: int, steps: int, warmup: int) -> float:
    """Learning-rate factor: a linear rise, then a cosine from 1 to a tenth."""
    if step < warmup:
        return (step + 1) / warmup
    done = (step - warmup) / max(1, steps - warmup)
    return 0.1 + 0.45 * (1 + math.cos(math.pi * done))


def fit(
    model: PretrainedTransformer,
    opt: Optimizer,
    config: OptimConfig,
    learning_rate: float,
    steps: int,
    batch: Callable[[int], Batch],
    progress: Callable[[int, float], None] = lambda step, value: None,
    first: int = 0,
) -> float:
    """Minimise eq. (1) for ``steps`` steps at peak rate ``learning_rate``; ``batch(step)`` draws the data.

    A step depends on its number, the weights and the optimizer alone, so a fit stopped after
    ``first`` steps goes on as if it had never stopped.  Returns the mean loss of the last
    tenth.  Raises FloatingPointError if the loss stops being a number.
    """
    model.train()
    warmup = min(config.warmup, max(1, steps // 10))
    total, counted = 0.0, 0
    for step in range(first, steps):
        value = batch_loss(model, batch(step))
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        opt.step(learning_rate * rate(step, steps, warmup))
        current = value.item()
        if not math.isfinite(current):
            raise FloatingPointError(f"loss is {current} at step {step}: lower the learning rate ({learning_rate})")
        if step >= steps - max(1, steps // 10):
            total, counted = total + current, counted + 1
        progress(step + 1, current)
    model.eval()
    return total / max(1, counted)
