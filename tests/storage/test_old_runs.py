"""A run folder with the names of version 0.1.0 and data of the present format is evaluated, watched, explained, continued and
forked; data of another format is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrl_dist.agent.loading import load_agent
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, Run, load, parse_written
from icrl_dist.launch import train
from icrl_dist.monitor.recording import Recording
from icrl_dist.storage import checkpoint
from icrl_dist.storage.checkpoint import (
    Checkpoint,
    load_checkpoint,
    partial_file,
    require_format,
    save_checkpoint,
    version_file,
)
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.stream.validation import VERSION
from icrl_dist.telemetry.metrics import Metrics
from learner import checkpoints, service

pytestmark = pytest.mark.integration

OLD = Path(__file__).parents[1] / "config" / "written_by_0_1_0"
TEXT = (OLD / "icag.toml").read_text()


def rewrite(path: Path, change: Callable[[dict[str, np.ndarray], dict[str, Any]], None]) -> None:
    """Change the arrays and the manifest of a checkpoint."""
    stored = load_checkpoint(path)
    arrays, manifest = dict(stored.arrays), dict(stored.manifest)
    change(arrays, manifest)
    save_checkpoint(path, Checkpoint(arrays, manifest))


def as_before(arrays: dict[str, np.ndarray], manifest: dict[str, Any]) -> None:
    """The names that version 0.1.0 wrote; the format stays."""
    for name in [name for name in arrays if name.startswith("optimizer/")]:
        arrays[name.replace("optimizer/", "optimiser/")] = arrays.pop(name)
    manifest["run"] = TEXT
    manifest["stretch"] = manifest.pop("window")
    made_by = manifest.pop("made_by")
    manifest["threads"] = made_by["threads"]
    manifest["versions"] = {"icrl-dist": "0.1.0", **{name: made_by["libraries"][name] for name in ("numpy", "torch")}}
    if "next_version" in manifest:
        manifest["produces"] = manifest.pop("next_version")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a finished run with the names of 0.1.0, and its result."""
    folder = tmp_path_factory.mktemp("runs") / "old"
    run = parse_written(TEXT, "x")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "Metrics", lambda folder, **options: Metrics(folder, tensorboard=False, **options))
        train.prepare(run, folder, resume=False, overwrite=False)
        result = train.train_inline(run, folder, lambda event: None)
    (folder / "run.toml").write_text(TEXT)
    for version in (0, 1):
        rewrite(version_file(folder, version), as_before)
    return folder, result


@pytest.fixture
def folder(finished: tuple[Path, dict[str, Any]], tmp_path: Path) -> Path:
    shutil.copytree(finished[0], tmp_path / "old")
    return tmp_path / "old"


def resumed(folder: Path) -> dict[str, Any]:
    run = load(str(folder / "run.toml"))
    train.prepare(run, folder, resume=True, overwrite=False)
    return train.train_inline(run, folder, lambda event: None)


def test_the_test_folder_has_the_names_that_0_1_0_wrote(folder: Path) -> None:
    with np.load(version_file(folder, 1)) as file:
        names, manifest = set(file.files), json.loads(file["manifest"].tobytes())
    recorded = json.loads((OLD / "manifest.json").read_text())
    assert set(manifest) - {"format"} == set(recorded) and manifest["run"] == recorded["run"]
    assert "a/optimiser/0/0/exp_avg" in names and not any("optimizer" in name for name in names)


def test_an_old_folder_is_evaluated_exported_watched_and_explained(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert load_agent(folder).manifest["window"] == 3
    words = ["--episodes", "1", "--seeds", "1", "--p", "0", "--json"]
    assert main.main(["evaluate", str(folder), *words]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["deploy"] == "committed"
    assert main.main(["export", str(folder), "--out", str(tmp_path / "agent.npz")]) == 0
    assert main.main(["evaluate", str(tmp_path / "agent.npz"), *words]) == 0
    assert main.main(["explain", str(folder), "adapt/0/0/0/0", "--rerun"]) == 0
    assert "the same bytes" in capsys.readouterr().out
    recording = Recording(folder)
    assert sum(1 for _ in recording.messages()) > 10
    recording.close()


def test_an_old_run_continues_to_the_same_bytes(finished: tuple[Path, dict[str, Any]], folder: Path) -> None:
    """T^1 is fitted again from T^0: its weights depend on the optimizer state that was stored as ``optimiser``."""
    version_file(folder, 1).unlink()
    result = resumed(folder)
    for name in ("dataset_digest", "weights_digest", "version", "trajectories"):
        assert result[name] == finished[1][name]


def test_an_unfinished_old_fit_continues(folder: Path) -> None:
    """The entry ``next_version`` of its checkpoint was called ``produces``."""
    partial = partial_file(folder)
    shutil.copy(version_file(folder, 0), partial)
    rewrite(partial, lambda arrays, manifest: manifest.update(produces=1, step=7))
    assert checkpoints.read_manifest(partial)["next_version"] == 1
    version_file(folder, 1).unlink()
    resumed(folder)
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if row["stage"] == "version"] == [0, 1]


def test_an_old_run_is_forked(folder: Path, tmp_path: Path) -> None:
    run: Run = load(str(folder / "run.toml"))
    train.prepare(run, tmp_path / "fork", resume=False, overwrite=False, source=(folder, 0))
    assert load_checkpoint(version_file(tmp_path / "fork", 0)).manifest["window"] == 3
    assert train.train_inline(run, tmp_path / "fork", lambda event: None)["version"] == 1


def test_a_run_of_another_format_is_evaluated_but_not_continued(folder: Path, tmp_path: Path) -> None:
    for version in (0, 1):
        rewrite(version_file(folder, version), lambda arrays, manifest: manifest.update(format=VERSION + 1))
    sentence = (
        rf"trained on data of format {VERSION + 1}, this version of icrl-dist continues only runs of format {VERSION}: "
        r"start a new run with another --out; `icrl-dist evaluate` and `export` still read the old one"
    )
    with pytest.raises(ConfigError, match=rf"version-000[01]\.npz: {sentence}"):
        resumed(folder)
    with pytest.raises(ConfigError, match=rf"--from .*old@0: {sentence}"):
        run = load(str(folder / "run.toml"))
        train.prepare(run, tmp_path / "fork", resume=False, overwrite=False, source=(folder, 0))
    assert not (tmp_path / "fork").exists()
    assert main.main(["evaluate", str(folder), "--episodes", "1", "--seeds", "1", "--p", "0"]) == 0
    assert main.main(["export", str(folder)]) == 0


def test_a_checkpoint_of_0_1_0_has_format_1(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = json.loads((OLD / "manifest.json").read_text())
    monkeypatch.setattr(checkpoint, "VERSION", 1)
    require_format(manifest, "x")
    monkeypatch.setattr(checkpoint, "VERSION", 2)
    with pytest.raises(ConfigError, match=r"x: trained on data of format 1, .* only runs of format 2"):
        require_format(manifest, "x")


def test_a_dataset_with_fewer_arrays_is_refused_with_what_still_works(folder: Path) -> None:
    """Datasets from before action windows have frames of 13 numbers."""
    from icrl_dist.storage.segment import TRAJECTORY, frame

    (folder / "dataset" / "segment-000000.frames").write_bytes(frame(TRAJECTORY, bytes([0x9D, *[1] * 13])))
    with pytest.raises(StoreError, match=r"start a new run with another --out; `icrl-dist evaluate` and `export`"):
        Dataset(folder / "dataset")
    assert load_agent(folder).manifest["version"] == 1
