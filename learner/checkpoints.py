"""What the learner must remember to go on: weights, optimizer, and where it stood."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from icrl_dist.agent.loading import spec_from
from icrl_dist.config.run import ConfigError, Run, dumps
from icrl_dist.models.weights import load_weights, weights_of
from icrl_dist.problems import registry
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, version_file
from icrl_dist.stream.wire import weights_digest
from icrl_dist.training.fit import Optimizer
from icrl_dist.types import Spec, Weights

PARTIAL = "partial.npz"


def manifest(run: Run, spec: Spec, version: int, threads: int) -> dict[str, Any]:
    """What a checkpoint says of itself: enough to deploy it, and to know where it comes from."""
    return {
        "method": run.method,
        "version": version,
        "run": dumps(run),
        "spec": dataclasses.asdict(spec),
        "problem": run.problem,
        "seed": run.seed,
        "horizon": spec.horizon,
        "window": run.model.window,
        **registry.of(run).manifest(),
        "threads": threads,
        "versions": {name: metadata.version(name) for name in ("icrl-dist", "numpy", "torch")},
    }


def weights(version: int, model: nn.Module) -> Weights:
    """The model's parameters as policy version ``version``, with their digest."""
    arrays = weights_of(model)
    return Weights(version, arrays, weights_digest(arrays))


def save(path: Path, weights: Weights, opt: Optimizer, about: Mapping[str, Any]) -> None:
    """Write weights, the optimizer's moments and the manifest atomically."""
    arrays = {f"model/{name}": value for name, value in weights.arrays.items()}
    arrays |= {f"optimizer/{name}": value.cpu().numpy() for name, value in opt.state().items()}
    save_checkpoint(path, Checkpoint(arrays, {**about, "weights_digest": weights.digest}))


def read_manifest(path: Path) -> Mapping[str, Any]:
    """A checkpoint's manifest alone."""
    return load_checkpoint(path).manifest


def restore(path: Path, spec: Spec, model: nn.Module, opt: Optimizer) -> Mapping[str, Any]:
    """Load what ``save`` wrote into model and optimizer; returns the manifest.

    Raises ConfigError for a checkpoint of another spec, another model size or another optimizer.
    """
    checkpoint = load_checkpoint(path)
    theirs = spec_from(checkpoint.manifest["spec"])
    if theirs != spec:
        raise ConfigError(f"{path}: a checkpoint of another spec ({theirs}), this run needs {spec}: use another --out")
    try:
        load_weights(model, checkpoint.part("model"))
    except RuntimeError as error:
        raise ConfigError(f"{path}: a checkpoint of another model ({' '.join(str(error).split())})") from None
    try:
        opt.load({name: torch.from_numpy(np.array(value)) for name, value in checkpoint.part("optimizer").items()})
    except ValueError as error:
        raise ConfigError(f"{path}: a checkpoint of another optimizer ({error}): it has the run's optim.muon") from None
    return checkpoint.manifest


def given_up(folder: Path, version: int) -> dict[str, str]:
    """The variations that were quarantined up to a version, and why."""
    return dict(read_manifest(version_file(folder, version)).get("quarantined", {})) if version >= 0 else {}


def weights_of_file(path: Path, version: int) -> Weights:
    """The weights in a checkpoint, as they were broadcast.  Raises StoreError if there is none."""
    arrays = load_checkpoint(path).part("model")
    return Weights(version, arrays, weights_digest(arrays))
