"""Damage, forks and overlapping rounds in complete runs: lost data is collected again with the same bytes."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrl_dist.collect import kinds
from icrl_dist.collect.adapt import rollouts
from icrl_dist.config.run import ConfigError, override
from icrl_dist.diagnostics import explain
from icrl_dist.launch import train
from icrl_dist.methods import examples
from icrl_dist.methods.icaa import ICAA
from icrl_dist.storage import files
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError, hold
from icrl_dist.storage.fork import parse_source
from icrl_dist.types import Identity, Variation
from learner import reporter, service
from tests.calls import noting
from tests.learner.test_service import no_tensorboard, parent, run_inline, same
from tests.optional import known

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard", "parent"]


def copy_of(parent, folder):
    """Copy the run, to damage it; returns the segments of its dataset."""
    return sorted((shutil.copytree(parent[0], folder) / "dataset").glob("segment-*"))


def flip(path, at):
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("segment", [0, 1])
def test_data_with_a_changed_byte_is_reported_and_collected_again(parent, tmp_path, segment):
    folder, events = tmp_path / "run", list[dict[str, Any]]()
    segments = copy_of(parent, folder)
    flip(segments[segment], segments[segment].stat().st_size // 2)
    result = run_inline(parent[2], folder, events.append, resume=True)
    assert same(result, parent[1]) and result["repaired"] == 1
    texts = [event["text"] for event in events if "text" in event]
    assert any(segments[segment].name in text and "damaged range" in text for text in texts)
    assert any("are missing: collecting them again" in text for text in texts)
    assert Dataset(folder / "dataset").digest() == parent[1]["dataset_digest"]


def test_a_missing_segment_is_collected_again_with_the_policy_version_of_its_round(parent, tmp_path):
    folder = tmp_path / "run"
    copy_of(parent, folder)[1].unlink()
    assert same(run_inline(parent[2], folder, resume=True), parent[1])


def damaging(folder):
    """A report that damages the pretraining data in the first round of ICAA; returns it and the list of what happened."""
    happened = list[Any]()

    def damage(event):
        if event.get("stage") == "collect" and event.get("phase") == "adapt" and not happened:
            happened.append(folder / "dataset" / "segment-000000.frames")
            flip(happened[0], happened[0].stat().st_size // 2)
        if event["event"] == "repaired":
            happened.append(event["text"])

    return damage, happened


def test_damage_during_a_run_is_found_before_training_uses_it(parent, tmp_path):
    folder, run = tmp_path / "run", override(parent[2], ["learner.cache_mb=0"], "--set")  # every example is read when drawn
    damage, happened = damaging(folder)
    result = run_inline(run, folder, damage)
    assert len(happened) == 2 and "segment-000000.frames: removed a damaged range" in happened[1]
    assert same(result, parent[1])


def test_damage_of_data_in_memory_changes_no_result_and_is_found_when_the_run_is_opened_again(parent, tmp_path):
    folder = tmp_path / "run"
    damage, happened = damaging(folder)
    assert same(run_inline(parent[2], folder, damage), parent[1]) and len(happened) == 1
    assert same(run_inline(parent[2], folder, damage, resume=True), parent[1])
    assert len(happened) == 2 and "segment-000000.frames: removed a damaged range" in happened[1]


def test_examples_of_removed_trajectories_are_made_anew_from_those_that_replace_them(parent, tmp_path, monkeypatch):
    """Round 1 finds damage; the repair also removes a trajectory of round 0, whose examples are in memory."""
    folder, flipped, replaced = tmp_path / "run", list[Path](), []
    work, data = kinds.do, ICAA.data

    def damage(event):
        if event.get("phase") == "adapt" and event.get("round") == 1 and event["step"] == event["steps"] and not flipped:
            flipped.extend(sorted((folder / "dataset").glob("segment-*"))[1:])
            for path in flipped:
                flip(path, path.stat().st_size // 2)

    def do(*args):
        for trajectory in work(*args):
            if flipped and trajectory.identity[:2] == ("adapt", 0):  # as under ``stream.staleness``, with other weights
                replaced.append(trajectory.identity)
                trajectory = dataclasses.replace(trajectory, actions=(trajectory.actions + 1) % 5)
            yield trajectory

    pools = list[Any]()

    def compare(method, run, phase, dataset):
        drawn = data(method, run, phase, dataset)
        if phase.round == 1:
            keys = [key for j in (0, 1) for key in dataset.variations("adapt", j)]
            for key, found in zip(keys, pools[-1][1].examples, strict=True):
                made = known(examples.self_labelled(run, dataset.trials(key)))
                np.testing.assert_array_equal(found.actions, made.actions, str(key))
                np.testing.assert_array_equal(found.labels, made.labels, str(key))
        return drawn

    monkeypatch.setattr(kinds, "do", do)
    monkeypatch.setattr(examples, "draw", noting(pools, lambda run, chosen: chosen, examples.draw))
    monkeypatch.setattr(ICAA, "data", compare)
    result = run_inline(parent[2], folder, damage)
    assert result["repaired"] == len(flipped) == 2 and replaced and len(pools) == 3


def test_a_folder_has_at_most_one_learner(parent, monkeypatch):
    monkeypatch.setattr(files, "hold", lambda folder: hold(folder, timeout_s=0.1))
    with hold(parent[0]), pytest.raises(StoreError, match="another learner uses this folder"):
        train.train_inline(parent[2], parent[0], print)


def test_a_fork_with_the_same_settings_ends_with_the_bytes_of_its_parent(parent, tmp_path):
    folder = tmp_path / "fork"
    assert same(run_inline(parent[2], folder, source=(parent[0], 1)), parent[1])
    names = [path.name for path in sorted((folder / "dataset").iterdir())]
    shared = [(folder / "dataset" / n).samefile(parent[0] / "dataset" / n) for n in names]
    assert shared == [True, True, False]
    assert (folder / "checkpoints" / "version-0001.npz").samefile(parent[0] / "checkpoints" / "version-0001.npz")


def test_a_fork_with_other_settings_keeps_the_data_of_its_parent(parent, tmp_path):
    folder, before = tmp_path / "fork", parent[1]["dataset_digest"]
    run = override(parent[2], ["adversary.count=1"], "--set")
    result = run_inline(run, folder, source=(parent[0], 1))
    counts = [7 * 3 * (run.icaa.trials + 1), 7 * 2 * (run.icaa.trials + 1)]
    assert result["trajectories"] == 42 + sum(counts) and result["weights_digest"] != parent[1]["weights_digest"]
    record = json.loads((folder / "fork.json").read_text())
    assert (record["from"], record["version"]) == (str(parent[0]), 1)
    assert explain.explain(folder, Identity("adapt", 0, 0, 2, 0))["from_ancestor"]
    flip(folder / "dataset" / "segment-000002.frames", 60)
    (folder / "dataset" / "segment-000001.frames").unlink()
    again = run_inline(run, folder, resume=True)
    assert same(again, result), "the data of an ancestor is collected with the settings of the ancestor"
    assert Dataset(parent[0] / "dataset", readonly=True).digest() == before
    grandchild = run_inline(run, tmp_path / "grandchild", source=(folder, 2))
    assert same(grandchild, result)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["model.width=32"], r"model\.width = 32 \(parent: 16\): a fork has its parent's problem, split, method and model"),
        (["darkroom.horizon=9"], r"darkroom\.horizon = 9 \(parent: 8\): a fork has its parent's problem, split, method"),
    ],
)
def test_an_incompatible_fork_is_refused(parent, tmp_path, settings, message):
    with pytest.raises(ConfigError, match=message):
        train.prepare(override(parent[2], settings, "--set"), tmp_path / "fork", False, False, (parent[0], 0))
    assert not (tmp_path / "fork" / "run.toml").exists()


def test_the_source_of_a_fork_is_checked(parent, tmp_path):
    assert parse_source(f"{parent[0]}@1") == (parent[0], 1)
    assert parse_source(str(parent[0])) == (parent[0], 2)
    for text, message in (
        (f"{parent[0]}@7", "holds versions 0 to 2"),
        (f"{parent[0]}@x", "RUN_DIR@ROUND"),
        (f"{tmp_path}@0", "holds no run"),
    ):
        with pytest.raises(ConfigError, match=message):
            parse_source(text)


def test_overlapping_rounds_use_policy_versions_at_most_one_old(parent, tmp_path):
    folder = tmp_path / "async"
    result = run_inline(override(parent[2], ["stream.staleness=1", "icaa.rounds=2"], "--set"), folder)
    store = Dataset(folder / "dataset", readonly=True)
    adapt = 7 * 3 * (parent[2].icaa.trials + 1)
    assert result["trajectories"] == 42 + 3 * adapt == len(store)
    lags = {int(lag): count for lag, count in result["lag"].items()}
    assert set(lags) == {0, 1} and sum(lags.values()) == 3 * adapt, (
        "the first jobs of round 1 are leased before T^1 is published"
    )
    for task in range(7):
        for round_ in range(3):
            acted = store.index.policy_versions("adapt", round_, (task - task % 2, task - task % 2 + 2))
            assert len(acted) == 1 and round_ - 1 <= acted[0] <= round_, "the same T^j acts in all trials of a job"
    assert parent[1]["lag"] == {"0": 2 * adapt} and parent[1]["staleness"] == 0


def test_a_stopped_asynchronous_run_continues_its_jobs_with_the_same_policy_versions(parent, tmp_path, monkeypatch):
    run = override(parent[2], ["stream.staleness=1", "icaa.rounds=2"], "--set")
    services = list[service.Service]()
    monkeypatch.setattr(service.Service, "run", noting(services, lambda self: self, service.Service.run))
    monkeypatch.setattr(reporter, "PERIOD_S", 0.0)

    def stop(event):
        if event.get("stage") == "fit" and event["version"] == 0:
            services[0].stop()

    with pytest.raises(train.TrainInterrupted):
        run_inline(run, tmp_path / "run", stop)
    result = run_inline(run, tmp_path / "run", resume=True)
    assert result["trajectories"] == 42 + 3 * 7 * 3 * (run.icaa.trials + 1)
    store = Dataset(tmp_path / "run" / "dataset", readonly=True)
    for round_ in range(3):
        for first in range(0, 7, 2):
            assert len(store.index.policy_versions("adapt", round_, (first, first + 2))) == 1


def test_explain_checks_every_file_of_a_trajectory(parent):
    folder, result, run = parent
    answer = explain.explain(folder, Identity("adapt", 1, 3, 2, 1), rerun=True)
    assert answer["rerun_equal"] and answer["intact"] and answer["weights_intact"] and not answer["from_ancestor"]
    assert (answer["policy_version"], answer["worker"], answer["label_origin"]) == (1, "w0", "self")
    assert answer["learned_by"] == ["T^2"] and answer["spawn_key"] == [1, 1, 3, 2, 1] and answer["seed"] == run.seed
    early = explain.explain(folder, Identity("pretrain", 0, 3, 0, 1), rerun=True)
    assert early["learned_by"] == ["T^0", "T^1", "T^2"] and early["label_origin"] == "optimal" and early["rerun_equal"]
    assert "rerun        the same bytes" in explain.describe(early)
    lines = list(explain.ledger(folder))
    assert len(lines) == result["trajectories"] and lines[0]["identity"] == "pretrain/0/0/0/0"
    with pytest.raises(ConfigError, match="has no trajectory adapt/9/0/0/0"):
        explain.explain(folder, Identity("adapt", 9, 0, 0, 0))


def test_a_rerun_with_other_bytes_is_reported(parent, monkeypatch):
    def other(*given):
        for trajectory in rollouts(*given):
            yield dataclasses.replace(trajectory, rewards=trajectory.rewards + 1)

    monkeypatch.setattr(kinds, "rollouts", other)
    answer = explain.explain(parent[0], Identity("adapt", 1, 3, 2, 1), rerun=True)
    assert answer["rerun_equal"] is False and "DIFFERENT bytes" in explain.describe(answer)


def test_a_variation_that_always_fails_is_quarantined_and_listed(parent, tmp_path, monkeypatch):
    run, broken = parent[2], list[Variation]()

    def failing(job, *rest):
        if not broken:
            broken.append(job.variations[4])  # in the first job: the second variation of the second task
        for trajectory in rollouts(job, *rest):
            if broken[0] in job.variations and trajectory.identity.trial == 1:
                raise ZeroDivisionError("this variation fails")
            yield trajectory

    monkeypatch.setattr(kinds, "rollouts", failing)
    folder, events = tmp_path / "run", list[dict[str, Any]]()
    result = run_inline(run, folder, events.append)
    ((quarantined,)) = result["quarantined"]
    assert quarantined["variation"] == "adapt/0/1/1" and "ZeroDivisionError: this variation fails" in quarantined["cause"]
    adapt = 7 * 3 * (run.icaa.trials + 1)
    assert result["trajectories"] == 42 + 2 * adapt - (run.icaa.trials + 1) and result["version"] == 2
    assert [e["identity"] for e in events if e["event"] == "quarantine"] == ["adapt/0/1/1"]
    assert list((folder / "crashes").glob("*.json"))
    assert same(run_inline(run, folder, resume=True), result), "quarantined variations are not collected again"
    assert same(run_inline(run, tmp_path / "again"), result), "the number of its stored trials makes no difference"
