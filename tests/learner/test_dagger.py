"""ICAG with DAgger rounds through the learner: interrupted runs, and explanations of trajectories."""

import dataclasses

import pytest

from icrl_dist.config.sections import DAggerConfig
from icrl_dist.diagnostics import explain
from icrl_dist.launch.train import TrainInterrupted
from icrl_dist.storage.checkpoint import partial_file
from icrl_dist.types import Identity
from learner import checkpoints, reporter, service
from tests.calls import noting
from tests.learner.test_service import no_tensorboard, run_inline, same

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard"]


@pytest.fixture
def run(small_run):
    return dataclasses.replace(
        small_run,
        method="icag",
        pretrain=dataclasses.replace(small_run.pretrain, behaviors=("random", "persistent", "goals", "sweep")),
        dagger=DAggerConfig(rounds=2, trials=3, steps=6),
        optim=dataclasses.replace(small_run.optim, muon=5.0, transitions=60),
    )


def test_an_interrupted_dagger_round_continues_to_the_same_bytes(run, tmp_path, monkeypatch):
    whole = run_inline(run, tmp_path / "whole")
    assert whole["version"] == 2
    assert whole["trajectories"] == 42 + 2 * 7 * run.adversary.variations * 3

    def stop(event):
        if event["event"] == "progress" and (event["stage"], event["version"]) == ("fit", 1) and event["step"] >= 3:
            services[0].stop()

    services = list[service.Service]()
    real = service.Service.run
    monkeypatch.setattr(service.Service, "run", noting(services, lambda self: self, real))
    monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
    with pytest.raises(TrainInterrupted):
        run_inline(run, tmp_path / "stopped", stop)
    partial = checkpoints.read_manifest(partial_file(tmp_path / "stopped"))
    assert partial["next_version"] == 2 and 0 < partial["step"] < 6
    monkeypatch.setattr(service.Service, "run", real)
    assert same(run_inline(run, tmp_path / "stopped", resume=True), whole)


def test_a_history_is_explained_and_reproduced(run, tmp_path):
    run_inline(run, tmp_path / "run")
    answer = explain.explain(tmp_path / "run", Identity("adapt", 1, 3, 2, 1), rerun=True)
    assert answer["rerun_equal"] and answer["policy_version"] == 1
    assert answer["label_origin"] == "optimal" and answer["learned_by"] == ["T^2"]
