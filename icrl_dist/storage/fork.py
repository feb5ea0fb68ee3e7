"""Forks: a run that begins with another's weights and data, and remembers whose they are."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, dumps, load, parse
from icrl_dist.storage.checkpoint import load_checkpoint, newest_version, version_file
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError, atomic_write
from icrl_dist.storage.sharing import adopt
from icrl_dist.types import Identity

_FILE = "fork.json"


@dataclass(frozen=True)
class Lineage:
    """Which numbers the data of each version was asked for with: the run's own, or an ancestor's."""

    own: Run
    ancestors: tuple[tuple[int, Run], ...] = ()
    """The newest version that each ancestor made, and its numbers; oldest first."""

    def run_of(self, version: int) -> Run:
        """The numbers that the data and the fit of this version come from."""
        return next((run for newest, run in self.ancestors if version <= newest), self.own)

    @classmethod
    def of(cls, folder: Path, run: Run) -> Lineage:
        """The lineage of the run in this folder.  Raises StoreError if its file is damaged."""
        path = folder / _FILE
        if not path.exists():
            return cls(run)
        try:
            fields = json.loads(path.read_text())
            return cls(run, tuple((int(item["version"]), parse(item["run"], str(path))) for item in fields["ancestors"]))
        except (KeyError, TypeError, ValueError) as error:
            raise StoreError(f"{path}: not a fork's record ({error}); restore it, or fork anew") from None


def parse_source(text: str) -> tuple[Path, int]:
    """``RUN_DIR@ROUND``, or ``RUN_DIR`` for its newest version.  Raises ConfigError if there is no such checkpoint."""
    name, _, round_ = text.rpartition("@")
    folder = Path(name or text)
    if name and not (round_.isascii() and round_.isdigit()):
        raise ConfigError(f"--from {text}: write RUN_DIR@ROUND, ROUND a number: the version T^ROUND to begin with")
    if not (folder / "run.toml").is_file():
        raise ConfigError(f"--from {text}: {folder} holds no run")
    newest = newest_version(folder)
    version = int(round_) if name else newest
    if version < 0 or not version_file(folder, version).is_file():
        raise ConfigError(f"--from {text}: {folder} holds the versions up to {newest}; name one of them")
    return folder, version


def fork(theirs: Path, version: int, run: Run, folder: Path) -> None:
    """Give ``folder`` the weights T^0 .. T^version of another run and the data they were fitted to.

    Files are shared, not copied, where the file system can.  Raises ConfigError if the runs do
    not fit together, StoreError if the data is not what the checkpoint names.
    """
    parent = load(str(theirs / "run.toml"))
    _same(parent, run, f"--from {theirs}@{version}")
    manifest: Mapping[str, Any] = load_checkpoint(version_file(theirs, version)).manifest
    if "dataset_digest" not in manifest:
        raise ConfigError(f"--from {theirs}@{version}: its checkpoint names no data: it is of an older version of icrl-dist")
    lineage = Lineage.of(theirs, parent)
    ancestors = [(newest, a) for newest, a in lineage.ancestors if newest < version] + [(version, lineage.run_of(version))]

    def keep(identity: Identity) -> bool:
        return identity.next_version <= version

    adopt(theirs / "dataset", folder / "dataset", keep)
    store = Dataset(folder / "dataset")
    digest = store.digest(version)
    store.close()
    if digest != manifest["dataset_digest"]:
        raise StoreError(
            f"{theirs}: its data of T^{version} ({digest[:16]}) is not what the checkpoint was fitted to "
            f"({manifest['dataset_digest'][:16]}): `icrl-dist train --resume` that run first, which collects what is missing"
        )
    for older in range(version + 1):
        _link(version_file(theirs, older), version_file(folder, older))
    record = {
        "from": str(theirs),
        "version": version,
        "weights_digest": manifest["weights_digest"],
        "dataset_digest": manifest["dataset_digest"],
        "ancestors": [{"version": newest, "run": dumps(ancestor)} for newest, ancestor in ancestors],
    }
    atomic_write(folder / _FILE, lambda file: file.write(json.dumps(record, indent=1).encode()))


def _same(parent: Run, run: Run, what: str) -> None:
    """Raises ConfigError, naming every number that differs, if the runs have another problem, split, method or model."""
    owner = plugins.find("problems", run.problem)
    differing = [
        (name, getattr(parent, name), getattr(run, name))
        for name in ("method", "problem")
        if getattr(parent, name) != getattr(run, name)
    ]
    sections = {"model": ()} if differing else {"model": (), owner.section: owner.free_in_forks}
    for section, free in sections.items():
        before, after = parent.section(section), run.section(section)
        differing += [
            (f"{section}.{item.name}", getattr(before, item.name), getattr(after, item.name))
            for item in dataclasses.fields(before)
            if item.name not in free and getattr(before, item.name) != getattr(after, item.name)
        ]
    if differing:
        named = ", ".join(f"{name} = {after!r} (parent: {before!r})" for name, before, after in differing)
        raise ConfigError(f"{what}: {named}: a fork has its parent's problem, split, method and model; begin a new run instead")


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
