"""The loss of the DPT family: eq. (1), and with action windows eq. (6)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from icrl_dist.models.dpt import PretrainedTransformer, Transitions, Windows
from icrl_dist.training.batches import TrainingBatch


def batch_loss(model: PretrainedTransformer, batch: TrainingBatch) -> Float[Tensor, ""]:
    """Eq. (1) over all (prefix, query) pairs of a batch; with windows also eq. (6).  Every label has the same weight."""
    device = model.low.device

    def put(array: object) -> Tensor:
        return torch.as_tensor(array, device=device)

    context = Transitions(*map(put, (batch.observations, batch.actions, batch.next_observations, batch.rewards)))
    cache = model.encode(context)
    total = model.action_head.loss(model.decide(put(batch.queries), cache, put(batch.prefix)), put(batch.labels))
    if batch.windows is not None:
        states, prev_actions, prev_rewards, labels = batch.windows
        windows = Windows(put(states), put(prev_actions), put(prev_rewards))
        outputs = model.decide_windows(windows, cache, put(batch.window_prefix))
        count = states.shape[1] * states.shape[2]
        share = count / (count + batch.prefix.shape[1])
        total = (1 - share) * total + share * model.action_head.loss(outputs, put(labels))
    return total
