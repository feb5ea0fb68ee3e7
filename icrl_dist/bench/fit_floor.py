"""The floating-point operations of a training step that are matrix products, from the shapes of its batch."""

from __future__ import annotations

import numpy as np

from icrl_dist.config.sections import ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.training.batches import TrainingBatch


def step_flops(model: PretrainedTransformer, batch: TrainingBatch, hidden: bool = False) -> int:
    """Floating-point operations of the products of one step, two for each multiplication, forward and backward.

    Every product of the forward pass has two in the backward pass: the gradients of its two factors.  Embeddings have
    one, because inputs need no gradient.  The attention of the last layer needs no queries of the context.
    ``hidden``: also for the pairs of tokens that a mask hides (later tokens of a context, transitions beyond a query's
    prefix): dense products compute them, the loss does not need them.  Padding counts as transitions do.
    """
    config, rows = model.config, len(batch.prefix)
    tokens, queries = batch.rewards.size, batch.prefix.size
    on_context, prefixes = _context_pairs(batch, hidden), [batch.prefix]
    on_windows = taken = 0
    if batch.windows is not None:
        assert batch.window_prefix is not None
        count, length = batch.windows.states.shape[1:3]
        prefixes.append(np.repeat(batch.window_prefix, length, axis=1))
        queries += rows * count * length
        on_windows = rows * count * (length**2 if hidden else length * (length + 1) // 2)
        taken = rows * count * (length - 1) * model.embed_taken.weight.numel()
    seen = sum(prefix.size * batch.rewards.shape[1] if hidden else int(prefix.sum()) for prefix in prefixes)
    embeddings = tokens * model.embed_transition.weight.numel() + queries * model.embed_query.weight.numel() + taken
    return 2 * (2 * embeddings + 3 * _trunk(config, tokens, queries, on_context, seen + on_windows, model.head.weight.numel()))


def _context_pairs(batch: TrainingBatch, hidden: bool) -> int:
    """Pairs of a context token and a context token that it attends to, in one layer."""
    rows, length = batch.rewards.shape
    return rows * (length**2 if hidden else length * (length + 1) // 2)


def _trunk(config: ModelConfig, tokens: int, queries: int, on_context: int, by_queries: int, head: int) -> int:
    """Multiplications of the trunk's and the head's forward pass.

    ``on_context``, ``by_queries``: pairs of tokens in one layer; a pair costs a product for its score and one for its value.
    """
    square, inner = config.width**2, config.layers - 1
    of_context = tokens * (12 * inner + 2) * square + inner * on_context * 2 * config.width
    of_queries = queries * (12 * config.layers * square + head) + config.layers * by_queries * 2 * config.width
    return of_context + of_queries
