"""Checkpoint and run are held to each other whenever a checkpoint of a run folder is opened.

A checkpoint of another run, another version or other settings is refused by name.  One whose bytes changed raises
``DamagedCheckpoint``: the learner fits it again, all other commands refuse it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from icrl_dist.config.run import ConfigError, Run, parse_written
from icrl_dist.config.sac import NOT_IN_TRAINING, SACConfig
from icrl_dist.storage.checkpoint import Checkpoint, DamagedCheckpoint, load_checkpoint, version_file
from icrl_dist.storage.files import StoreError, require_plain
from icrl_dist.storage.fork import Lineage
from icrl_dist.stream import wire

_FREE: Mapping[str, tuple[str, ...] | None] = {
    "stream": ("job_tasks", "staleness"),
    "sac": tuple(field.name for field in dataclasses.fields(SACConfig) if field.name not in NOT_IN_TRAINING),
    "learner": ("reproducible",),
    **dict.fromkeys(("evaluate", "alerts"), ()),
}
"""Sections on whose other fields no digest depends; each with the fields on which one does."""


def differences(run: Run, other: Run) -> list[str]:
    """The settings on which data or weights depend and that differ from ``other``, that of run.toml, as text each."""
    return [f"{name} = {value!r} (run.toml: {another!r})" for name, value, another in _differences(run, other)]


def _differences(run: Run, other: Run) -> Iterator[tuple[str, object, object]]:
    for name in ("problem", "method", "seed"):
        if getattr(run, name) != getattr(other, name):
            yield name, getattr(run, name), getattr(other, name)
    for field in dataclasses.fields(run):
        part: Any = getattr(run, field.name)
        another: Any = getattr(other, field.name, None)
        if not dataclasses.is_dataclass(part) or type(another) is not type(part):
            continue
        compared = _FREE.get(field.name)
        for item in dataclasses.fields(part):
            before, after = getattr(part, item.name), getattr(another, item.name)
            if before != after and (compared is None or item.name in compared):
                yield f"{field.name}.{item.name}", before, after


def opened(folder: Path, version: int, lineage: Lineage) -> Checkpoint:
    """The checkpoint of T^version in a run folder.

    Raises DamagedCheckpoint if it is missing or its bytes changed, StoreError if it is that of another version or run.
    """
    path = version_file(folder, version)
    require_plain(path)
    checkpoint = load_checkpoint(path)
    hold(checkpoint, path, version, lineage.run_of(version))
    return checkpoint


def hold(checkpoint: Checkpoint, path: Path, version: int, run: Run) -> None:
    """Raises as ``opened`` does, unless the checkpoint is that of T^version of this run with the weights that it names."""
    manifest, remedy = checkpoint.manifest, "move it away; `icrl-dist train --resume` then makes the right one again"
    if (found := manifest.get("version")) != version:
        raise StoreError(f"{path}: holds T^{found}, not T^{version}: {remedy}")
    try:
        fitted = parse_written(str(manifest.get("run", "")), str(path))
    except ConfigError as error:
        raise StoreError(f"{error}: {remedy}") from None
    if differing := differences(fitted, run):
        raise StoreError(
            f"{path}: is of a run with other settings, {', '.join(differing[:5])}: restore run.toml if it was changed, "
            f"else {remedy}"
        )
    check_weights(checkpoint, path)


def check_weights(checkpoint: Checkpoint, path: Path) -> None:
    """Raises DamagedCheckpoint unless all arrays are finite and the weights have the digest that the manifest names."""
    for name, array in checkpoint.arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise DamagedCheckpoint(f"{path}: {name} are no finite numbers, so it is damaged or its training diverged")
    digest = checkpoint.manifest.get("weights_digest")
    if digest is not None and wire.weights_digest(checkpoint.part("model")) != digest:
        raise DamagedCheckpoint(f"{path}: damaged, its weights do not have the digest that it names ({str(digest)[:16]})")
