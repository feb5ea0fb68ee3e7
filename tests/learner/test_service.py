"""Complete runs in one process: an interruption changes no byte of the result."""

import dataclasses
import json
import shutil
import sys
from typing import Any

import numpy as np
import pytest

from icrl_dist.agent.loading import load_agent
from icrl_dist.config.run import ConfigError, dumps
from icrl_dist.launch import train
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.problems.darkroom.problem import DarkRoomProblem
from icrl_dist.storage.checkpoint import partial_file, version_file
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.telemetry.metrics import Metrics
from learner import checkpoints, reporter, service
from tests.calls import noting

pytestmark = pytest.mark.integration


def run_inline(run, folder, report=lambda event: None, **options):
    train.prepare(run, folder, **{"resume": False, "overwrite": False, **options})
    return train.train_inline(run, folder, report)


@pytest.fixture(autouse=True, scope="module")
def no_tensorboard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "Metrics", lambda folder, **options: Metrics(folder, tensorboard=False, **options))
        yield


@pytest.fixture(scope="module")
def parent(module_run, no_tensorboard, tmp_path_factory):
    """An undisturbed run that no test changes: its folder, its result and its settings."""
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    with pytest.MonkeyPatch.context() as patch:
        for name in ("torch._dynamo", "torch._inductor"):  # importing torch's compiler would delay the start of the learner
            patch.setitem(sys.modules, name, None)
        return folder, run_inline(module_run, folder), module_run


@pytest.fixture(scope="module")
def undisturbed(parent):
    return parent[1]


def same(result, other):
    names = ("dataset_digest", "weights_digest", "trajectories", "version")
    return [result[n] for n in names] == [other[n] for n in names]


def test_a_run_stores_every_trajectory_once_with_the_policy_version_of_its_round(small_run, parent):
    folder, undisturbed, _ = parent
    store = Dataset(folder / "dataset", readonly=True)
    versions = [checkpoints.read_manifest(version_file(folder, v)) for v in range(3)]
    for identity in [row.identity for row in store.index]:
        t = store.read(identity)
        if identity.stage == "adapt":
            assert (t.policy_version, t.weights_digest) == (identity.round, versions[identity.round]["weights_digest"])
        else:
            assert (t.policy_version, t.weights_digest) == (-1, "")
    adapt = 7 * 3 * (small_run.icaa.trials + 1)
    assert undisturbed["trajectories"] == len(store) == 42 + 2 * adapt
    store.close()
    assert undisturbed["weights_digest"] == versions[2]["weights_digest"]
    assert undisturbed["version"] == 2 and undisturbed["drops"] == {}


def test_a_repeated_run_gives_the_same_bytes_and_another_seed_other_bytes(small_run, tmp_path, undisturbed):
    assert same(run_inline(small_run, tmp_path / "again"), undisturbed)
    other = run_inline(dataclasses.replace(small_run, seed=1), tmp_path / "other")
    assert other["dataset_digest"] != undisturbed["dataset_digest"]


@pytest.mark.parametrize("when", [("collect", 0, 20), ("fit", 0, 4), ("collect", 2, 40), ("fit", 2, 3)])
def test_a_run_stopped_at_any_step_resumes_to_the_same_bytes(small_run, tmp_path, undisturbed, when, monkeypatch):
    what, next_version, step = when
    stopped = list[dict[str, Any]]()

    def stop_at(event):
        at = event.get("stage"), event.get("version", -2) + 1
        if event["event"] == "progress" and at == (what, next_version) and event["step"] >= step and not stopped:
            stopped.append(event)
            services[0].stop()

    services = list[service.Service]()
    monkeypatch.setattr(service.Service, "run", noting(services, lambda self: self, service.Service.run))
    monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
    folder = tmp_path / "stopped"
    with pytest.raises(train.TrainInterrupted):
        run_inline(small_run, folder, stop_at)
    assert stopped
    if what == "fit":
        partial = checkpoints.read_manifest(partial_file(folder))
        assert partial["next_version"] == next_version and 0 < partial["step"] < small_run.pretrain.steps
    assert same(run_inline(small_run, folder, resume=True), undisturbed)


def test_the_agent_of_a_run_loads_with_a_complete_manifest(parent):
    folder, undisturbed, _ = parent
    agent = load_agent(folder, seed=0)
    manifest = agent.manifest
    assert manifest["weights_digest"] == undisturbed["weights_digest"]
    assert (manifest["size"], manifest["horizon"], manifest["version"]) == (3, 8, 2)
    assert len(manifest["test_goals"]) == 2 and all(len(goal) == 2 for goal in manifest["test_goals"])
    json.dumps(manifest)
    agent.reset_context(batch=2)
    assert agent.act(np.zeros((2, 2))).shape == (2,)


def test_an_existing_folder_and_changed_settings_are_refused(small_run, tmp_path, parent):
    folder = shutil.copytree(parent[0], tmp_path / "undisturbed")
    with pytest.raises(ConfigError, match="exists: use --resume"):
        train.prepare(small_run, folder, resume=False, overwrite=False)
    with pytest.raises(ConfigError, match="has other settings"):
        train.prepare(dataclasses.replace(small_run, seed=5), folder, resume=True, overwrite=False)
    with pytest.raises(ConfigError, match="holds no run"):
        train.prepare(small_run, tmp_path / "nothing", resume=True, overwrite=False)
    wide = dataclasses.replace(small_run, model=dataclasses.replace(small_run.model, width=32))
    (folder / "run.toml").write_text(dumps(wide))
    with pytest.raises(StoreError, match=r"settings, model\.width = 16 \(run\.toml: 32\)"):
        run_inline(wide, folder, resume=True)
    large = dataclasses.replace(small_run, darkroom=dataclasses.replace(small_run.darkroom, horizon=9))
    (folder / "run.toml").write_text(dumps(large))
    with pytest.raises(StoreError, match=r"settings, darkroom\.horizon = 8 \(run\.toml: 9\)"):
        run_inline(large, folder, resume=True)


def test_a_job_that_always_fails_ends_the_run_with_the_cause(small_run, tmp_path, monkeypatch):
    def broken(problem, variations):
        raise ZeroDivisionError("the environment broke")

    monkeypatch.setattr(DarkRoomProblem, "batch", broken)
    with pytest.raises(TrainFailed, match=r"no trajectory was stored, and .* ZeroDivisionError: the environment broke"):
        run_inline(small_run, tmp_path / "broken")
