"""torch's optimizers without the import of torch's compiler.

torch wraps some methods of its optimizers to exclude them from compilation; at the first call these
wrappers import the compiler, which takes as long as the import of torch itself, and 70 MB, in every
process that trains.
"""

from __future__ import annotations

import inspect
from typing import TypeVar

import torch
from torch.optim import Optimizer

_Kind = TypeVar("_Kind", bound=Optimizer)


def _uncompiled(kind: type[_Kind]) -> type[_Kind]:
    """The optimizer with these methods unwrapped."""
    for name in ("add_param_group", "state_dict", "load_state_dict", "zero_grad"):
        setattr(kind, name, inspect.unwrap(getattr(kind, name)))
    setattr(kind, "step", torch.no_grad()(inspect.unwrap(kind.step)))  # noqa: B010
    return kind


@_uncompiled
class AdamW(torch.optim.AdamW):
    """Adam with decoupled weight decay."""


@_uncompiled
class Adam(torch.optim.Adam):
    """Adam."""


@_uncompiled
class Muon(torch.optim.Muon):
    """Muon, for matrices."""
