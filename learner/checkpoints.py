"""The learner's checkpoints: weights, optimizer state and manifest."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from icrl_dist.agent.loading import spec_from
from icrl_dist.config.run import ConfigError, Run, dumps
from icrl_dist.models.weights import load_weights, weights_of
from icrl_dist.problems import registry
from icrl_dist.storage.checkpoint import Checkpoint, DamagedCheckpoint, load_checkpoint, require_format, save_checkpoint
from icrl_dist.stream import wire
from icrl_dist.stream.validation import VERSION
from icrl_dist.telemetry import provenance
from icrl_dist.training.fit import Optimizer
from icrl_dist.training.kernel_fit import KernelFit
from icrl_dist.types import Spec, Weights


def manifest(run: Run, spec: Spec, version: int, threads: int, device: str = "cpu") -> dict[str, Any]:
    """The manifest of a checkpoint: what its deployment needs, and its origin.

    ``threads``: CPU threads of the fit; ``device``: ``cpu``, or the name of the GPU.
    """
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
        "format": VERSION,
        "made_by": provenance.record(run.problem, run.method, threads, device, run.learner.reproducible),
    }


def weights(version: int, model: nn.Module) -> Weights:
    """The parameters of the model as policy version ``version``, with their digest."""
    arrays = weights_of(model)
    return Weights(version, arrays, wire.weights_digest(arrays))


def save(path: Path, weights: Weights, opt: Optimizer | KernelFit, about: Mapping[str, Any]) -> None:
    """Write weights, optimizer state and manifest atomically."""
    arrays = {f"model/{name}": value for name, value in weights.arrays.items()}
    arrays |= {f"optimizer/{name}": value for name, value in opt.state().items()}
    save_checkpoint(path, Checkpoint(arrays, {**about, "weights_digest": weights.digest}))


def read_manifest(path: Path) -> Mapping[str, Any]:
    """The manifest of a checkpoint."""
    return load_checkpoint(path).manifest


def restore(path: Path, spec: Spec, model: nn.Module, opt: Optimizer | KernelFit) -> Mapping[str, Any]:
    """Load a checkpoint of ``save`` into model and optimizer; returns the manifest.

    Raises ConfigError, and changes neither, for a checkpoint of another spec, data format, model size or optimizer.
    """
    checkpoint = load_checkpoint(path)
    require_format(checkpoint.manifest, str(path))
    found = spec_from(checkpoint.manifest["spec"])
    if found != spec:
        raise ConfigError(f"{path}: a checkpoint of another spec ({found}), this run needs {spec}: use another --out")
    arrays, state = checkpoint.part("model"), checkpoint.part("optimizer")
    own = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    if own != {name: array.shape for name, array in arrays.items()}:
        raise ConfigError(f"{path}: a checkpoint of another model, its arrays have other names or shapes: use another --out")
    try:
        opt.load(state)
    except ValueError as error:
        raise ConfigError(f"{path}: a checkpoint of another optimizer ({error}): use the optim.muon of its run") from None
    load_weights(model, arrays)
    return checkpoint.manifest


def weights_of_file(path: Path, version: int) -> Weights:
    """The weights in a checkpoint, with their digest.  Raises StoreError for a missing or damaged one."""
    checkpoint = load_checkpoint(path)
    arrays = checkpoint.part("model")
    digest = wire.weights_digest(arrays)
    if digest != checkpoint.manifest.get("weights_digest", digest):
        raise DamagedCheckpoint(f"{path}: damaged, its weights do not have the digest that it names")
    return Weights(version, arrays, digest)
