"""The ingest benchmark: what it counts went through the real inbox and store, and it refuses to measure nothing."""

from __future__ import annotations

import json
from collections import namedtuple
from pathlib import Path

import pytest

from icrl_dist.bench import ingest
from icrl_dist.config.run import ConfigError


@pytest.fixture
def on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "file_system", lambda folder: "ext4")


def test_it_measures_both_ways_and_leaves_nothing_behind(
    on_disk: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    real = ingest.Dataset
    monkeypatch.setattr(ingest, "Dataset", lambda folder, durable: opened.append(durable) or real(folder, durable=durable))
    result = ingest.run(tmp_path / "here", seconds=0.4, pairs=2)
    assert opened == [True, False, True, True, False]  # to warm up, then by turns
    assert result["durable_per_s"] > 0 and result["ratio"] > 0 and result["fsync_p50_ms"] > 0
    assert 1 <= result["trajectories_an_fsync"] <= result["credits"]
    assert len(result["pairs"]) == 2 and result["file_system"] == "ext4"
    assert json.loads(json.dumps(result)) == result
    assert f"{result['ratio']:.2f}; ext4" in ingest.describe(result)
    assert list((tmp_path / "here").iterdir()) == []


def test_a_file_system_in_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "file_system", lambda folder: "tmpfs")
    with pytest.raises(ConfigError, match=r"lies on tmpfs, .* --folder"):
        ingest.run(tmp_path)


@pytest.mark.parametrize(("wrong", "message"), [({"seconds": 0.0}, r"seconds = 0\.0"), ({"pairs": 0}, "pairs = 0")])
def test_what_it_cannot_measure_is_refused(on_disk: None, tmp_path: Path, wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ingest.run(tmp_path, **wrong)


def test_a_folder_lies_on_the_mount_nearest_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mount = namedtuple("mount", ["mountpoint", "fstype"])
    mounts = [
        mount("/", "ext4"),
        mount(str(tmp_path), "xfs"),
        mount(str(tmp_path), "tmpfs"),
        mount(str(tmp_path / "a"), "btrfs"),
    ]
    monkeypatch.setattr(ingest.psutil, "disk_partitions", lambda all: mounts)
    found = [ingest.file_system(Path(p)) for p in ("/", tmp_path, tmp_path / "ab" / "c", tmp_path / "a" / "missing")]
    assert found == ["ext4", "tmpfs", "tmpfs", "btrfs"]
