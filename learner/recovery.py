"""What a run folder still holds when the learner opens it: the checkpoints that can be used, and what must be made again.

A checkpoint that is damaged or missing is fitted again, from the version before it and the data of its phase.  One of
another run is refused, because it may be the only copy of that run's file.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from icrl_dist.collect.checks import largest
from icrl_dist.config.run import Run
from icrl_dist.storage.checkpoint import Checkpoint, DamagedCheckpoint, load_checkpoint, newest_version, require_format
from icrl_dist.storage.checkpoint import version_file as file_of
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError, require_plain
from icrl_dist.storage.fork import Lineage
from icrl_dist.storage.held import differences, hold
from icrl_dist.types import Spec, Weights

Note = Callable[[str], None]


def intact(folder: Path, run: Run, lineage: Lineage, last: int, note: Note) -> dict[int, Mapping[str, Any]]:
    """The manifests of the versions whose checkpoints can be used; ``note`` gets a line about each that must be fitted again.

    ``last``: the last version of the run.  Raises StoreError for a checkpoint of another run, and for one that this run
    cannot fit again because another run did.
    """
    found: dict[int, Mapping[str, Any]] = {}
    newest = newest_version(folder)
    if newest > last:
        raise StoreError(f"{file_of(folder, newest)}: this run has the versions 0 to {last} only: move it away")
    for version in range(newest + 1):
        path = file_of(folder, version)
        try:
            checkpoint = _read(path)
            hold(checkpoint, path, version, lineage.run_of(version))
            found[version] = checkpoint.manifest
        except DamagedCheckpoint as error:
            if differences(lineage.run_of(version), run):
                raise StoreError(f"{error}; {_origin(folder)}") from None
            note(f"{error}: T^{version} is fitted again")
    return found


def _read(path: Path) -> Checkpoint:
    require_plain(path)
    checkpoint = load_checkpoint(path)
    require_format(checkpoint.manifest, str(path))
    return checkpoint


def _origin(folder: Path) -> str:
    """The remedy for a lost checkpoint of the run that this one was forked from."""
    try:
        parent = json.loads((folder / "fork.json").read_text())["from"]
    except (OSError, ValueError, KeyError, TypeError):
        parent = "the run that this one was forked from"
    return f"it was fitted with other settings than this run's, so it is lost here: copy it from {parent}"


def continues(path: Path, run: Run, version: int, steps: int, note: Note) -> bool:
    """Whether ``path`` holds an unfinished fit of T^(version + 1) that can be continued; a broken one is expendable.

    ``steps``: those of the whole fit.
    """
    if not path.exists():
        return False
    try:
        checkpoint = _read(path)
        if checkpoint.manifest.get("next_version") != version + 1:
            return False
        hold(checkpoint, path, version, run)
        step = checkpoint.manifest.get("step")
        if not isinstance(step, int) or not 0 < step <= steps:
            raise DamagedCheckpoint(f"{path}: damaged, its step is {step!r}, not one of 1 to {steps}")
        if not checkpoint.part("optimizer"):
            raise DamagedCheckpoint(f"{path}: damaged, it holds no state of the optimizer")
    except (StoreError, ValueError) as error:
        note(starts_again(error, version))
        return False
    return True


def starts_again(error: Exception, version: int) -> str:
    """What is said about an unfinished fit of T^(version + 1) that cannot be continued."""
    return f"{error}: the fit of T^{version + 1} starts at its beginning"


def largest_values(store: Dataset, spec: Spec, version: int) -> str:
    """Where the largest values of the data of T^version are, for the message about a fit that diverged."""
    found = largest((store.read(row.identity) for row in store.index), spec, lambda t: t.identity.next_version <= version)
    return f"; the largest values of its data are in {found}" if found else ""


@dataclasses.dataclass
class DataCheck:
    """Holds the dataset to the checkpoints, once, when the data of every fitted version is complete."""

    folder: Path
    manifests: Mapping[int, Mapping[str, Any]]
    """Those of the intact checkpoints."""
    excused: str = ""
    """Why data that was collected again can differ; empty if it cannot."""
    collected: bool = False
    """Whether data of a fitted version was collected again."""

    def weights(self, store: Dataset) -> None:
        """Raises StoreError if trajectories were made by other weights than those of the version that they name."""
        for version, digest, identity in store.index.made_by():
            known = self.manifests.get(version, {}).get("weights_digest", digest)
            if known != digest:
                raise StoreError(
                    f"{store.folder}: {identity} was made by weights {digest[:16]}, but T^{version} has {known[:16]}: its "
                    "dataset or its checkpoint is of another run; restore the right one, or start a new run with another --out"
                )

    def accept(self, store: Dataset) -> Callable[[Weights], None]:
        """A function that raises StoreError for weights that were fitted again and differ from those that made stored data."""

        def accept(weights: Weights) -> None:
            for version, digest, identity in store.index.made_by():
                if version == weights.version and digest != weights.digest:
                    raise StoreError(
                        f"{self.folder}: T^{version} is lost; fitted again it has weights {weights.digest[:16]}, but "
                        f"{identity} was made by {digest[:16]}: use the software and hardware of the run's start, "
                        "or a copy of the checkpoint"
                    )

        return accept

    def data(self, store: Dataset, quarantined: Mapping[str, str], note: Note) -> None:
        """Raises StoreError if the data of the newest version is not what its checkpoint was fitted to."""
        version = max(self.manifests, default=-1)
        manifest, self.manifests = self.manifests.get(version, {}), {}
        wanted, found = manifest.get("dataset_digest"), store.digest(version)
        if wanted in (None, found):
            return
        about = (
            f"{store.folder}: the data of T^{version} has the digest {found[:16]}, its checkpoint was fitted to {wanted[:16]}"
        )
        excused = self.excused if self.collected else ""
        if set(quarantined) != set(manifest.get("quarantined", {})):
            excused = "a variation is quarantined now"
        if not excused:
            raise StoreError(
                f"{about}: its dataset or its checkpoint is of another run; restore the right one, or start a new run "
                "with another --out"
            )
        note(f"{about}: {excused}")
