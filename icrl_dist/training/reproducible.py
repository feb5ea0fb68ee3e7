"""Whether the fits of a run can go through the compiled kernel: ``learner.reproducible``."""

from __future__ import annotations

import platform
from pathlib import Path

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.config.sections import Reproducible
from icrl_dist.models.compiled import WIDEST, Unusable, library

_GPU_FILES = ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd")
"""Files of which one is present wherever torch can use a GPU."""


def best_fit(run: Run) -> Reproducible:
    """What ``learner.reproducible = "auto"`` means for a run that begins here with its ``context.decoder``.

    With ``learner.device = "auto"`` a GPU is used if there is one.
    """
    return "this-machine" if _objection(run) or (run.learner.device == "auto" and _gpu()) else "any-machine"


def require_kernel_fit(run: Run) -> None:
    """Raises ConfigError if ``learner.reproducible`` is any-machine and this run cannot be fitted so here."""
    if run.learner.reproducible == "any-machine" and (objection := _objection(run)):
        raise ConfigError(f"learner.reproducible = 'any-machine': {objection}, or set learner.reproducible = 'this-machine'")


def _objection(run: Run) -> str:
    """Why the kernel cannot fit this run here, and the remedy; empty if it can."""
    found = plugins.find("methods", run.method)()
    if not found.fits_by_kernel:
        return f"method = {run.method!r} has a model or a loss of its own, which only torch computes: use dpt, icag or icaa"
    if run.model.width > WIDEST:
        return f"model.width = {run.model.width}: the kernel is for models up to {WIDEST} wide: use at most {WIDEST}"
    if run.model.dropout:
        return f"model.dropout = {run.model.dropout}: the kernel has no dropout: use 0"
    if isinstance(why := library("training"), Unusable):
        return f"on {platform.node()} the training kernel cannot be used: {why}"
    if run.context.decoder == "torch":
        return "context.decoder = 'torch', whose decisions depend on the processor: set context.decoder = 'kernel'"
    if run.learner.device == "cuda":
        return "learner.device = 'cuda', and the kernel runs on the CPU: set learner.device = 'auto' or 'cpu'"
    return ""


def _gpu() -> bool:
    """Whether torch finds a GPU; torch is imported only where it could."""
    if not any(map(Path.exists, map(Path, _GPU_FILES))):
        return False
    import torch

    return torch.cuda.is_available()
