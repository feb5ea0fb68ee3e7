"""Parameters of a model as numpy arrays, out and in."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import nn

from icrl_dist.models.stored import check_shapes


def weights_of(model: nn.Module) -> dict[str, np.ndarray]:
    """The parameters as numpy arrays by name: copies, little-endian."""
    return {name: value.detach().cpu().numpy().copy() for name, value in model.state_dict().items()}


def share_weights(model: nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Make the parameters views of these arrays, by name: who writes to the arrays changes the model, without a copy."""
    for name, parameter in model.named_parameters():
        parameter.data = torch.from_numpy(arrays[name])


def load_weights(model: nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError naming the parameters unless names and shapes are the model's own."""
    check_shapes(((name, tuple(value.shape)) for name, value in model.state_dict().items()), arrays)
    model.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in arrays.items()})
