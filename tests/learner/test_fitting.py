"""The fit of one policy version: how often its weights are hashed."""

import dataclasses

import pytest

from actors.weight_cache import WeightCache
from icrl_dist.launch import train
from icrl_dist.storage.checkpoint import load_checkpoint, version_file
from icrl_dist.stream import wire
from icrl_dist.telemetry.metrics import Metrics
from learner import fitting, service
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
