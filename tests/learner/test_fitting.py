"""The fit of one policy version: how often its weights are hashed, and its metrics after a kill."""

import collections
import dataclasses
import shutil

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from actors.weight_cache import WeightCache
from icrl_dist.launch import train
from icrl_dist.storage.checkpoint import load_checkpoint, version_file
from icrl_dist.stream import wire
from icrl_dist.telemetry import metric_rows
from icrl_dist.telemetry.metrics import Metrics
from learner import fitting, reporter, service
from tests.calls import keeping


@pytest.fixture
def hashed(monkeypatch):
    """The digest of every call of ``wire.weights_digest`` in this process, which has no worker that receives weights."""
    digests = list[str]()
    monkeypatch.setattr(wire, "weights_digest", keeping(digests, wire.weights_digest))
    monkeypatch.setattr(WeightCache, "_on_broadcast", lambda self, key, payload: None)
    monkeypatch.setattr(service, "Metrics", lambda folder, **options: Metrics(folder, tensorboard=False, **options))
    return digests


@pytest.mark.parametrize("save_steps", [1000, 5])
def test_a_fit_hashes_its_weights_once_and_a_resume_once(small_run, tmp_path, hashed, monkeypatch, save_steps):
    monkeypatch.setattr(fitting, "SAVE_STEPS", save_steps)
    run = dataclasses.replace(small_run, method="dpt")  # one fit, and no jobs that need its weights
    assert run.dagger.rounds == 0 and run.pretrain.steps % 5 == 0
    folder = tmp_path / "run"
    train.prepare(run, folder, resume=False, overwrite=False)
    result = train.train_inline(run, folder, lambda event: None)
    saved = load_checkpoint(version_file(folder, 0)).manifest["weights_digest"]
    assert hashed.count(saved) == 1 and result["weights_digest"] == saved
    unfinished = run.pretrain.steps // save_steps - (save_steps == 5)  # checkpoints of the unfinished fit: other weights
    assert len(hashed) == 1 + unfinished and len(set(hashed)) == len(hashed)
    hashed.clear()
    train.prepare(run, folder, resume=True, overwrite=False)
    assert train.train_inline(run, folder, lambda event: None)["weights_digest"] == saved
    assert hashed == [saved]


def test_steps_after_the_last_checkpoint_are_in_the_metrics_once(small_run, tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "SAVE_STEPS", 100)
    run = dataclasses.replace(small_run, method="dpt", pretrain=dataclasses.replace(small_run.pretrain, steps=250))
    folder = tmp_path / "run"

    class Killed(Exception):  # noqa: N818
        pass

    def report(event):
        if event.get("stage") == "fit" and event["step"] >= 170:
            shutil.copy(folder / "checkpoints/partial.npz", tmp_path / "of-step-100")
            raise Killed

    monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
    train.prepare(run, folder, resume=False, overwrite=False)
    with pytest.raises(Killed):
        train.train_inline(run, folder, report)
    shutil.copy(tmp_path / "of-step-100", folder / "checkpoints/partial.npz")  # a kill leaves no time for a later one
    before = [row for row in metric_rows.read(folder) if row["stage"] == "fit/0"]
    assert [row["step"] for row in before] == [50, 100, 150], "the checkpoint is of step 100"
    train.prepare(run, folder, resume=True, overwrite=False)
    train.train_inline(run, folder, lambda event: None)
    rows = list(metric_rows.read(folder))
    for stage, steps in (("fit/0", [50, 100, 150, 200, 250]), ("collect", [0]), ("version", [0])):
        assert [row["step"] for row in rows if row["stage"] == stage] == steps
    again = [row for row in rows if row["stage"] == "fit/0"][2]
    assert again["time"] > before[2]["time"], (again, before)
    assert again["loss"] == before[2]["loss"], "the same fit, later"
    numbers = collections.Counter[tuple[str, int]]()
    for file in (folder / "tensorboard").iterdir():
        shown = EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload()
        numbers.update((tag, one.step) for tag in shown.Tags()["scalars"] for one in shown.Scalars(tag))
    assert set(numbers.values()) == {1} and sorted(step for tag, step in numbers if tag == "fit/0/loss") == [
        50,
        100,
        150,
        200,
        250,
    ]
