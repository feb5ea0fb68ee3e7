"""A trained model with the run that trained it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Method
from icrl_dist.types import Spec


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A model, and the run, method and spec that its deployment needs."""

    run: Run
    method: Method
    spec: Spec
    model: torch.nn.Module
