"""Forks: a run that starts with the weights and data of another run, and records the origin of each."""

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
from icrl_dist.config.run import ConfigError, Run, dumps, load_folder, parse_written
from icrl_dist.storage.checkpoint import load_checkpoint, newest_version, require_format, version_file
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError, write_json
from icrl_dist.storage.sharing import adopt
from icrl_dist.types import Identity

_FILE = "fork.json"


@dataclass(frozen=True)
class Lineage:
    """The settings that the data of each version was collected with: the run's own, or an ancestor's."""

    own: Run
    ancestors: tuple[tuple[int, Run], ...] = ()
    """The newest version that each ancestor trained, and its settings; oldest first."""

    def run_of(self, version: int) -> Run:
        """The settings of the run that collected the data of this version and fitted it."""
        return next((run for newest, run in self.ancestors if version <= newest), self.own)

    @classmethod
    def of(cls, folder: Path, run: Run) -> Lineage:
        """The lineage of the run in this folder.  Raises StoreError if its file is damaged."""
        path = folder / _FILE
        if not path.exists():
            return cls(run)
        try:
            fields = json.loads(path.read_text())
            return cls(
                run, tuple((int(item["version"]), parse_written(item["run"], str(path))) for item in fields["ancestors"])
            )
        except (KeyError, TypeError, ValueError) as error:
            raise StoreError(f"{path}: not the record of a fork ({error}); restore the file, or make the fork again") from None


def parse_source(text: str) -> tuple[Path, int]:
    """Run folder and version of ``RUN_DIR@ROUND``, or of ``RUN_DIR`` (its newest version).

    Raises ConfigError if there is no such checkpoint.
    """
    name, _, round_ = text.rpartition("@")
    folder = Path(name or text)
    if name and not (round_.isascii() and round_.isdigit()):
        raise ConfigError(f"--from {text}: write RUN_DIR@ROUND, where ROUND is the number of the version T^ROUND to start from")
    if not (folder / "run.toml").is_file():
        raise ConfigError(f"--from {text}: {folder} holds no run")
    newest = newest_version(folder)
    version = int(round_) if name else newest
    if version < 0 or not version_file(folder, version).is_file():
        found = f"versions 0 to {newest}; name one of them" if newest >= 0 else "no checkpoint yet; train that run first"
        raise ConfigError(f"--from {text}: {folder} holds {found}")
    return folder, version


def fork(theirs: Path, version: int, run: Run, folder: Path) -> None:
    """Put the weights T^0 to T^version of another run, and the data that they were fitted to, into ``folder``.

    Files are linked, not copied, if the file system supports it.  Raises ConfigError if the runs differ in what
    a fork may not change, StoreError if the digest of the data is not the one in the checkpoint.
    """
    parent = load_folder(theirs)
    _check_same(parent, run, f"--from {theirs}@{version}")
    manifest: Mapping[str, Any] = load_checkpoint(version_file(theirs, version)).manifest
    require_format(manifest, f"--from {theirs}@{version}")
    if "dataset_digest" not in manifest:
        problem = "its checkpoint, of an older version of icrl-dist, holds no dataset digest; train that run again"
        raise ConfigError(f"--from {theirs}@{version}: {problem}")
    lineage = Lineage.of(theirs, parent)
    ancestors = [(newest, a) for newest, a in lineage.ancestors if newest < version] + [(version, lineage.run_of(version))]

    def is_needed(identity: Identity) -> bool:
        return identity.next_version <= version

    adopt(theirs / "dataset", folder / "dataset", is_needed)
    store = Dataset(folder / "dataset")
    digest = store.digest(version)
    store.close()
    if digest != manifest["dataset_digest"]:
        raise StoreError(
            f"{theirs}: the data of T^{version} (digest {digest[:16]}) is not the data that the checkpoint was fitted to "
            f"({manifest['dataset_digest'][:16]}): run `icrl-dist train --resume` on that run first; it collects missing data"
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
    write_json(folder / _FILE, record)


def _check_same(parent: Run, run: Run, what: str) -> None:
    """Raises ConfigError, with every setting that differs, if the runs differ in problem, split, method or model."""
    problem = plugins.find("problems", run.problem)
    differing = [
        (name, getattr(parent, name), getattr(run, name))
        for name in ("method", "problem")
        if getattr(parent, name) != getattr(run, name)
    ]
    sections = {"model": ()} if differing else {"model": (), problem.section: problem.free_in_forks}
    for section, free in sections.items():
        before, after = parent.section(section), run.section(section)
        differing += [
            (f"{section}.{item.name}", getattr(before, item.name), getattr(after, item.name))
            for item in dataclasses.fields(before)
            if item.name not in free and getattr(before, item.name) != getattr(after, item.name)
        ]
    if differing:
        named = ", ".join(f"{name} = {after!r} (parent: {before!r})" for name, before, after in differing)
        raise ConfigError(f"{what}: {named}: a fork has its parent's problem, split, method and model; start a new run instead")


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
