"""The scale benchmark: trajectories of every simulated worker are stored and counted."""

import json

import pytest

from icrl_dist.bench import ingest, scale
from icrl_dist.bench.stream import LIMIT
from icrl_dist.config.run import ConfigError
from icrl_dist.stream import wire


@pytest.fixture
def on_disk(monkeypatch):
    monkeypatch.setattr(ingest, "file_system", lambda folder: "ext4")


def test_replayed_trajectories_differ_only_in_their_trial():
    recorded = scale.Recorded(7)
    first, second = (wire.decode_trajectory(recorded.next(), LIMIT) for _ in range(2))
    assert second.identity == first.identity._replace(trial=first.identity.trial + 1) and first.identity.task == 7
    assert {name: array.tobytes() for name, array in first.arrays().items()} == {
        name: array.tobytes() for name, array in second.arrays().items()
    }


def test_it_measures_every_number_of_workers_and_removes_its_files(on_disk, tmp_path, monkeypatch):
    stored = []
    real = scale._ingest

    def counting_ingest(store, count, times, failures):
        made = real(store, count, times, failures)
        take = made.take

        def counted(group):
            take(group)
            stored.append({row.identity.task for row in store.index})

        monkeypatch.setattr(made, "take", counted)
        return made

    monkeypatch.setattr(scale, "_ingest", counting_ingest)
    result = scale.run(tmp_path / "here", seconds=1.0, workers=(1, 6))
    assert stored[-1] == set(range(6)), "a worker has no stored trajectory"
    one, six = result["rows"]
    assert (one["workers"], six["workers"]) == (1, 6)
    for row in result["rows"]:
        assert row["ingest_per_s"] > 0 and 0 < row["ack_p50_ms"] <= row["ack_p99_ms"]
        assert row["trajectories"] >= row["workers"] and isinstance(row["kb_a_worker"], float) and row["mb"] > 0
    best = max(one["ingest_per_s"], six["ingest_per_s"])
    assert result["ingest_per_s"] == best
    assert result["knee_workers"] == (1 if one["ingest_per_s"] >= 0.9 * best else 6)
    assert json.loads(json.dumps(result)) == result
    assert f"knee: {result['knee_workers']} workers" in scale.describe(result)
    assert list((tmp_path / "here").iterdir()) == []


def test_invalid_arguments_are_refused(on_disk, tmp_path, monkeypatch):
    for wrong in ({"seconds": 0.0}, {"workers": ()}, {"workers": (0,)}):
        with pytest.raises(ConfigError, match="must be above 0"):
            scale.run(tmp_path, **wrong)
    monkeypatch.setattr(ingest, "file_system", lambda folder: "tmpfs")
    with pytest.raises(ConfigError, match=r"is on tmpfs, .* --folder"):
        scale.run(tmp_path)
