"""The scale benchmark: every simulated worker is heard, and what is counted was stored."""

import json

import pytest

from icrl_dist.bench import ingest, scale
from icrl_dist.config.run import ConfigError
from icrl_dist.stream import wire


@pytest.fixture
def on_disk(monkeypatch):
    monkeypatch.setattr(ingest, "file_system", lambda folder: "ext4")


def test_what_is_replayed_differs_in_its_trial_only():
    recorded = scale.Recorded(7)
    first, second = (wire.decode_trajectory(recorded.next(), scale.LIMIT) for _ in range(2))
    assert second.identity == first.identity._replace(trial=first.identity.trial + 1) and first.identity.task == 7
    assert {name: array.tobytes() for name, array in first.arrays().items()} == {
        name: array.tobytes() for name, array in second.arrays().items()
    }


def test_it_measures_every_size_and_leaves_nothing_behind(on_disk, tmp_path, monkeypatch):
    stored = []
    real = scale._inbox

    def inbox(store, count, times, failures):
        made = real(store, count, times, failures)
        take = made.take

        def counted(group):
            take(group)
            stored.append({row.identity.task for row in store.index})

        made.take = counted
        return made

    monkeypatch.setattr(scale, "_inbox", inbox)
    result = scale.run(tmp_path / "here", seconds=1.0, workers=(1, 6))
    assert stored[-1] == set(range(6)), "a worker was not heard"
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


def test_what_it_cannot_measure_is_refused(on_disk, tmp_path, monkeypatch):
    for wrong in ({"seconds": 0.0}, {"workers": ()}, {"workers": (0,)}):
        with pytest.raises(ConfigError, match="must be above 0"):
            scale.run(tmp_path, **wrong)
    monkeypatch.setattr(ingest, "file_system", lambda folder: "tmpfs")
    with pytest.raises(ConfigError, match=r"lies on tmpfs, .* --folder"):
        scale.run(tmp_path)
