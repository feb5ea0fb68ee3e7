"""The ingest benchmark: it counts trajectories of the real ingest and store, and refuses invalid arguments."""

from __future__ import annotations

import json
from collections import namedtuple
from pathlib import Path
from typing import Any

import psutil
import pytest

from icrl_dist.bench import ingest
from icrl_dist.config.run import ConfigError
from icrl_dist.storage.dataset import Dataset
from tests.calls import noting


@pytest.fixture
def on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "file_system", lambda folder: "ext4")


def test_it_measures_with_and_without_fsync_and_removes_its_files(
    on_disk: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = list[bool]()
    monkeypatch.setattr(ingest, "Dataset", noting(opened, lambda folder, durable: durable, Dataset))
    result = ingest.run(tmp_path / "here", seconds=0.4, pairs=2)
    assert opened == [True, False, True, True, False]  # the warm-up, then alternating
    assert result["durable_per_s"] > 0 and result["ratio"] > 0 and result["fsync_p50_ms"] > 0
    assert 1 <= result["trajectories_an_fsync"] <= result["credits"]
    assert len(result["pairs"]) == 2 and result["file_system"] == "ext4"
    assert json.loads(json.dumps(result)) == result
    assert f"{result['ratio']:.2f}; ext4" in ingest.describe(result)
    assert list((tmp_path / "here").iterdir()) == []


def test_a_file_system_in_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "file_system", lambda folder: "tmpfs")
    with pytest.raises(ConfigError, match=r"is on tmpfs, .* --folder"):
        ingest.run(tmp_path)


@pytest.mark.parametrize(("wrong", "message"), [({"seconds": 0.0}, r"seconds = 0\.0"), ({"pairs": 0}, "pairs = 0")])
def test_invalid_arguments_are_refused(on_disk: None, tmp_path: Path, wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ingest.run(tmp_path, **wrong)


def test_the_file_system_is_that_of_the_nearest_mount(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mount = namedtuple("mount", ["mountpoint", "fstype"])
    mounts = [
        mount("/", "ext4"),
        mount(str(tmp_path), "xfs"),
        mount(str(tmp_path), "tmpfs"),
        mount(str(tmp_path / "a"), "btrfs"),
    ]
    monkeypatch.setattr(psutil, "disk_partitions", lambda all: mounts)
    found = [ingest.file_system(Path(p)) for p in ("/", tmp_path, tmp_path / "ab" / "c", tmp_path / "a" / "missing")]
    assert found == ["ext4", "tmpfs", "tmpfs", "btrfs"]
