"""Damage to a run folder: mended with the same digests at the end, or refused in one line that names the file."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run, dumps, override
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.launch.train import TrainInterrupted
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, partial_file, save_checkpoint, version_file
from icrl_dist.storage.dataset import Dataset, segment_path
from icrl_dist.storage.files import StoreError
from learner import reporter, service
from tests.calls import noting
from tests.learner.test_recovery import flip
from tests.learner.test_service import no_tensorboard, parent, run_inline, same

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard", "parent"]


@pytest.fixture(scope="module")
def another(parent, tmp_path_factory):
    """The same run with another seed."""
    folder = tmp_path_factory.mktemp("runs") / "another"
    run_inline(dataclasses.replace(parent[2], seed=1), folder)
    return folder


@pytest.fixture
def damaged(parent, tmp_path):
    """A copy of the undisturbed run, to damage it."""
    return shutil.copytree(parent[0], tmp_path / "run")


def resumed(folder: Path, run: Run) -> tuple[dict[str, Any], list[str]]:
    """The result of a resume, and the texts of its notes."""
    events = list[dict[str, Any]]()
    result = run_inline(run, folder, events.append, resume=True)
    return result, [event["text"] for event in events if "text" in event]


def changed(path: Path, **manifest: object) -> None:
    """Write a checkpoint again with other entries in its manifest."""
    found = load_checkpoint(path)
    save_checkpoint(path, Checkpoint(found.arrays, {**found.manifest, **manifest}))


def with_value(path: Path, prefix: str, value: float) -> None:
    """Write a checkpoint again with one value of one array changed."""
    found = load_checkpoint(path)
    arrays = {name: np.array(array) for name, array in found.arrays.items()}
    name = next(name for name, array in arrays.items() if name.startswith(prefix) and array.size > 1)
    arrays[name].flat[0] = value
    save_checkpoint(path, Checkpoint(arrays, found.manifest))


DAMAGE = {
    "a flipped bit": lambda path: flip(path, path.stat().st_size // 2),
    "no bytes": lambda path: path.write_bytes(b""),
    "cut": lambda path: os.truncate(path, path.stat().st_size - 100),
    "missing": lambda path: path.unlink(),
    "weights that are not a number": lambda path: with_value(path, "model/", np.nan),
    "other weights": lambda path: with_value(path, "model/", 0.5),
    "an optimizer state that is infinite": lambda path: with_value(path, "optimizer/", np.inf),
}


@pytest.mark.parametrize("version", [0, 1, 2])
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_checkpoint_is_fitted_again_to_the_same_weights(parent, damaged, version, damage):
    if (damage == "missing" and version == 2) or (damage not in ("a flipped bit", "missing") and version == 1):
        return  # without its newest checkpoint a run is one that was interrupted
    before = [load_checkpoint(version_file(damaged, v)).manifest["weights_digest"] for v in range(3)]
    DAMAGE[damage](version_file(damaged, version))
    result, texts = resumed(damaged, parent[2])
    assert same(result, parent[1])
    (text,) = [text for text in texts if "is fitted again" in text]
    assert str(version_file(damaged, version)) in text and text.endswith(f"T^{version} is fitted again") and "\n" not in text
    assert [load_checkpoint(version_file(damaged, v)).manifest["weights_digest"] for v in range(3)] == before
    assert not [text for text in resumed(damaged, parent[2])[1] if "again" in text]


def test_weights_that_are_needed_to_collect_data_again_are_fitted_first(parent, damaged):
    flip(version_file(damaged, 0), 3000)
    segment = segment_path(damaged / "dataset", 1)  # of round 0, which T^0 collected
    flip(segment, segment.stat().st_size // 2)
    result, texts = resumed(damaged, parent[2])
    assert same(result, parent[1]) and result["repaired"] == 1
    assert any("T^0 is fitted again" in text for text in texts)


def test_weights_that_are_lost_during_a_run_end_it_in_one_line_and_resume_fits_them_again(parent, damaged):
    segment = segment_path(damaged / "dataset", 1)
    flip(segment, segment.stat().st_size // 2)
    lost = list[dict[str, Any]]()

    def lose(event):
        if event["event"] == "note" and "are missing" in event["text"] and not lost:
            lost.append(event)
            version_file(damaged, 0).write_bytes(b"")

    with pytest.raises((TrainFailed, StoreError), match=r"version-0000\.npz: .*"):
        run_inline(parent[2], damaged, lose, resume=True)
    assert lost and same(resumed(damaged, parent[2])[0], parent[1])


def stopped(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was stopped in its first fit; returns the checkpoint of that fit."""
    services = list[service.Service]()

    def stop(event):
        if event.get("stage") == "fit" and event["step"] >= 4:
            services[0].stop()

    with monkeypatch.context() as patch:
        patch.setattr(service.Service, "run", noting(services, lambda self: self, service.Service.run))
        patch.setattr(reporter, "PERIOD_S", 0.0)
        with pytest.raises(TrainInterrupted):
            run_inline(run, folder, stop)
    return partial_file(folder)


@pytest.mark.parametrize(
    "damage",
    [
        "a flipped bit",
        "no bytes",
        "other weights",
        "another seed",
        "no step",
        "step -5",
        "step 1000000",
        "no moments",
        "no state",
    ],
)
def test_an_unfinished_fit_that_is_damaged_starts_at_its_beginning(parent, tmp_path, monkeypatch, damage):
    partial = stopped(parent[2], tmp_path / "run", monkeypatch)
    if damage == "another seed":
        changed(partial, run=dumps(dataclasses.replace(parent[2], seed=1)))
    elif damage == "no step":
        changed(partial, step="four")
    elif damage.startswith("step"):
        changed(partial, step=int(damage.split()[1]))
    elif damage in ("no moments", "no state"):
        whole, end = load_checkpoint(partial), "/0/exp_avg" if damage == "no moments" else ""
        kept = {n: array for n, array in whole.arrays.items() if not n.startswith("optimizer/") or not n.endswith(end)}
        save_checkpoint(partial, Checkpoint(kept, whole.manifest))
    else:
        DAMAGE[damage](partial)
    result, texts = resumed(tmp_path / "run", parent[2])
    assert same(result, parent[1])
    (text,) = [text for text in texts if "partial" in text]
    assert text.endswith("the fit of T^0 starts at its beginning")


def refused(folder: Path, run: Run) -> str:
    """The message with which a resume is refused; nothing of the folder's checkpoints and data is changed."""
    kept = {path: path.read_bytes() for part in ("checkpoints", "dataset") for path in (folder / part).iterdir()}
    with pytest.raises((StoreError, ConfigError)) as error:
        run_inline(run, folder, resume=True)
    assert {path: path.read_bytes() for part in ("checkpoints", "dataset") for path in (folder / part).iterdir()} == kept
    text = str(error.value)
    assert "\n" not in text
    return text


def test_a_checkpoint_of_another_seed_is_refused_by_name(parent, damaged, another):
    for version in (1, 2):
        shutil.copy(version_file(another, version), version_file(damaged, version))
        text = refused(damaged, parent[2])
        assert text.startswith(f"{version_file(damaged, version)}: is of a run with other settings, seed = 1 (run.toml: 0)")
        shutil.copy(version_file(parent[0], version), version_file(damaged, version))


def test_a_checkpoint_of_another_version_is_refused_by_name(parent, damaged):
    shutil.copy(version_file(damaged, 1), version_file(damaged, 2))
    assert refused(damaged, parent[2]).startswith(f"{version_file(damaged, 2)}: holds T^1, not T^2: move it away")
    version_file(damaged, 2).rename(damaged.parent / "moved")  # the remedy
    assert same(resumed(damaged, parent[2])[0], parent[1])
    shutil.copy(version_file(damaged, 2), version_file(damaged, 7))
    assert f"{version_file(damaged, 7)}: this run has the versions 0 to 2 only" in refused(damaged, parent[2])


def test_a_dataset_of_another_seed_is_refused(parent, damaged, another):
    shutil.rmtree(damaged / "dataset")
    shutil.copytree(another / "dataset", damaged / "dataset")
    assert "is of another run" in refused(damaged, parent[2])


def test_a_segment_of_another_seed_is_refused_even_if_it_holds_undisturbed_tasks_only(parent, damaged, another):
    first = segment_path(damaged / "dataset", 0)
    shutil.copy(segment_path(another / "dataset", 0), first)
    text = refused(damaged, parent[2])
    assert "the data of T^2 has the digest" in text and "is of another run" in text


def test_a_changed_run_file_is_refused(parent, damaged):
    run = override(parent[2], ["seed=5"], "--set")
    (damaged / "run.toml").write_text(dumps(run))
    assert "restore run.toml if it was changed" in refused(damaged, run)


def test_settings_on_which_no_digest_depends_are_not_compared(parent, damaged):
    run = override(
        parent[2], ["evaluate.episodes=4", "learner.cache_mb=1", "stream.lease_s=70.0", "alerts.labels=0.1"], "--set"
    )
    (damaged / "run.toml").write_text(dumps(run))
    assert same(resumed(damaged, run)[0], parent[1])


def test_a_stored_trajectory_that_is_out_of_bounds_is_collected_again(parent, tmp_path, monkeypatch):
    partial = stopped(parent[2], tmp_path / "run", monkeypatch)
    partial.unlink()
    folder = tmp_path / "run" / "dataset"
    store = Dataset(folder)
    trajectories = [store.read(row.identity) for row in store.index]
    store.close()
    shutil.rmtree(folder)
    trajectories[3] = dataclasses.replace(trajectories[3], rewards=np.full_like(trajectories[3].rewards, 3e38))
    store = Dataset(folder)
    store.append(trajectories)
    store.close()
    result, texts = resumed(tmp_path / "run", parent[2])
    assert same(result, parent[1]) and result["repaired"] == 1
    assert any(f"{trajectories[3].identity}: rewards[0] = 3e+38 lies outside 0..1" in text for text in texts)


def odd(kind: str, path: Path, outside: Path) -> None:
    """Put an odd file in the place of a file of the run."""
    kept = path.read_bytes() if path.is_file() else b""
    path.unlink(missing_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "link":
            outside.write_bytes(kept)
            path.symlink_to(outside)


@pytest.mark.parametrize("kind", ["pipe", "folder", "link"])
@pytest.mark.parametrize(
    "name",
    [
        *("dataset/segment-000001.frames", "checkpoints/version-0000.npz", "checkpoints/partial.npz", "metrics.jsonl", ".lock"),
        *("env.json", "run.toml", "learner.log", "endpoint", "fork.json"),
    ],
)
def test_an_odd_file_is_refused_by_name_and_nothing_is_written_through_a_link(parent, damaged, tmp_path, kind, name):
    odd(kind, damaged / name, tmp_path / "outside")
    before = (tmp_path / "outside").read_bytes() if kind == "link" else b""
    with pytest.raises((StoreError, ConfigError), match=str(damaged / name)) as error:
        run_inline(parent[2], damaged, resume=True)
    assert "\n" not in str(error.value)
    assert kind != "link" or (tmp_path / "outside").read_bytes() == before


@pytest.mark.parametrize("name", ["dataset", "checkpoints", "tensorboard", "crashes", "results", "report"])
def test_a_linked_folder_is_refused_by_name_and_nothing_is_written_into_it(parent, damaged, tmp_path, name):
    if (damaged / name).exists():
        (damaged / name).rename(tmp_path / "outside")
    else:
        (tmp_path / "outside").mkdir()
    (damaged / name).symlink_to(tmp_path / "outside")
    before = sorted(path.name for path in (tmp_path / "outside").iterdir())
    with pytest.raises((StoreError, ConfigError), match=f"{damaged / name}: is a link"):
        run_inline(parent[2], damaged, resume=True)
    assert sorted(path.name for path in (tmp_path / "outside").iterdir()) == before


@pytest.mark.parametrize("name", ["segment-1.frames", "segment-000099.frames", "segment-000003.frames", "segment-x.frames"])
def test_a_segment_with_a_number_out_of_order_is_refused_by_name(parent, damaged, name):
    shutil.copy(segment_path(damaged / "dataset", 1), damaged / "dataset" / name)
    assert str(damaged / "dataset" / name) in refused(damaged, parent[2])


@pytest.mark.parametrize(("number", "size"), [(0, 0), (1, 0), (1, 1000)])
def test_a_cut_segment_is_named_and_its_data_is_collected_again(parent, damaged, number, size):
    path = segment_path(damaged / "dataset", number)
    os.truncate(path, size)
    result, texts = resumed(damaged, parent[2])
    assert same(result, parent[1]) and any(path.name in text for text in texts)
    assert not [text for text in resumed(damaged, parent[2])[1] if path.name in text]


def test_a_missing_segment_is_named_once(parent, damaged):
    segment_path(damaged / "dataset", 1).unlink()
    result, texts = resumed(damaged, parent[2])
    assert same(result, parent[1]) and "segment-000001.frames: is missing" in texts
    assert not [text for text in resumed(damaged, parent[2])[1] if "missing" in text]


def test_a_lost_checkpoint_of_a_parent_with_other_settings_is_refused_with_the_parents_folder(parent, tmp_path):
    run, folder = override(parent[2], ["pretrain.steps=11"], "--set"), tmp_path / "fork"
    run_inline(run, folder, source=(parent[0], 1))
    shutil.copy(version_file(folder, 0), tmp_path / "copy")
    version_file(folder, 0).unlink()
    assert refused(folder, run).endswith(f"so it is lost here: copy it from {parent[0]}")
    shutil.copy(tmp_path / "copy", version_file(folder, 0))
    assert not [text for text in resumed(folder, run)[1] if "again" in text]


def test_a_fit_that_explodes_is_an_alert_and_ends_the_run_in_one_line(module_run, tmp_path):
    run, events = override(module_run, ["optim.learning_rate=1000.0"], "--set"), list[dict[str, Any]]()
    with pytest.raises(TrainFailed, match=r"the fit of T\^0 diverged: .*lower the learning rate \(1000\)") as error:
        run_inline(run, tmp_path / "run", events.append)
    assert "\n" not in str(error.value) and "pretrain/0/" in str(error.value)
    assert [e["text"] for e in events if e["event"] == "alert" and "ALERT: the fit of T^0 diverged" in e["text"]]
    assert '"stage": "alert"' in (tmp_path / "run" / "metrics.jsonl").read_text()
    assert not version_file(tmp_path / "run", 0).exists()
