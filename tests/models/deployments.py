"""The implementations of ``models.deployed.Deployed``, for tests that hold each of them to the network of training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from icrl_dist.models.deployed import Columns, Deployed
from icrl_dist.models.dpt import DeployedTransformer, PretrainedTransformer, Transitions
from icrl_dist.models.kernel import Kernel
from icrl_dist.models.kernel_transformer import KernelTransformer
from icrl_dist.models.weights import weights_of

Deploy = Callable[[PretrainedTransformer, int], Deployed]
IMPLEMENTATIONS = ("torch", "avx2", "avx512", "neon")


def deployment(name: str) -> Deploy:
    """The implementation of that name: torch, or the kernel for an instruction set."""
    if name == "torch":
        return DeployedTransformer
    return lambda model, batch: KernelTransformer(model.spec, model.config, weights_of(model), batch, Kernel(name))


def columns(transitions: Transitions) -> Columns:
    return Columns(*(column.numpy() for column in transitions))


def close(found: np.ndarray, expected: torch.Tensor) -> None:
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-5, rtol=1e-5)
