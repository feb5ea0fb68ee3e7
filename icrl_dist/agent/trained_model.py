"""A trained model and the run that it comes from."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Method
from icrl_dist.types import Spec


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """What is needed to deploy a model."""

    run: Run
    method: Method
    spec: Spec
    model: torch.nn.Module
