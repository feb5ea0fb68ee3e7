"""Durable, in canonical order, and honest about damage."""

import dataclasses

import numpy as np
import pytest

from icrl_dist import jobs
from icrl_dist.recipes import METHODS
from icrl_dist.store import Checkpoint, StoreError, load_checkpoint, save_checkpoint
from icrl_dist.store import Store as RealStore
from icrl_dist.stream import wire
from icrl_dist.types import Identity


@pytest.fixture
def trajectories(small_run):
    phase = METHODS["dpt"].phases(small_run)[0]
    return [t for job in METHODS["dpt"].ask(small_run, phase)[:2] for t in jobs.do(job, None, "w")]


@pytest.fixture
def Store():  # noqa: N802 - stands for the class
    """Stores that are closed when the test ends."""
    opened = []

    def make(*arguments, **options):
        opened.append(RealStore(*arguments, **options))
        return opened[-1]

    yield make
    for store in opened:
        store.close()


def items(trajectories):
    return [(t, wire.encode_trajectory(t)) for t in trajectories]


def test_what_was_appended_is_there_after_reopening_in_canonical_order(Store, tmp_path, trajectories):
    store = Store(tmp_path)
    store.append(items(trajectories[5:]))
    store.append(items(trajectories[:5]))
    again = Store(tmp_path)
    assert len(again) == len(trajectories) and not again.repaired
    assert [t.identity for t in again.select("pretrain", 0)] == [t.identity for t in trajectories]
    for t in trajectories:
        assert wire.trajectory_digest(again.read(t.identity)) == wire.trajectory_digest(t)
    assert trajectories[0].identity in again and Identity("adapt", 0, 0, 0, 0) not in again


def test_the_digest_depends_on_the_bytes_and_not_on_order_or_worker(Store, tmp_path, trajectories, small_run):
    one, two, three = (Store(tmp_path / name) for name in "abc")
    one.append(items(trajectories))
    job = METHODS["dpt"].ask(small_run, METHODS["dpt"].phases(small_run)[0])
    others = [t for j in job[:2] for t in jobs.do(j, None, "another worker")]
    two.append(items(others[::-1]))
    assert one.digest() == two.digest()
    changed = others[0].rewards.copy()
    changed[2] += 1
    three.append(items([dataclasses.replace(others[0], rewards=changed), *others[1:]]))
    assert three.digest() != one.digest()


def test_a_torn_tail_is_cut_and_reported_and_the_rest_stays(Store, tmp_path, trajectories):
    store = Store(tmp_path)
    store.append(items(trajectories))
    store.close()
    (segment,) = tmp_path.glob("segment-*")
    whole = segment.read_bytes()
    last = Store(tmp_path).index[trajectories[-1].identity]
    for cut in (len(whole) - 1, last.offset + 3, last.offset - 3):
        segment.write_bytes(whole[:cut])
        torn = Store(tmp_path)
        assert len(torn.repaired) == 1 and "torn tail" in torn.repaired[0]
        assert len(torn) == len(trajectories) - 1 and trajectories[-1].identity not in torn
        torn.append(items(trajectories[-1:]))
        torn.close()
        assert segment.read_bytes() == whole


def test_damage_before_the_tail_is_an_error_that_names_file_and_byte(Store, tmp_path, trajectories):
    store = Store(tmp_path)
    store.append(items(trajectories))
    store.close()
    entry = store.index[trajectories[1].identity]
    damaged = bytearray(entry.segment.read_bytes())
    damaged[entry.offset + 10] ^= 1
    entry.segment.write_bytes(damaged)
    with pytest.raises(StoreError, match=rf"{entry.segment.name}: damaged at byte {entry.offset - 8}"):
        Store(tmp_path)


def test_segments_are_sealed_at_their_size(Store, tmp_path, trajectories):
    store = Store(tmp_path, seal_bytes=1000)
    for item in items(trajectories):
        store.append([item])
    assert len(list(tmp_path.glob("segment-*"))) > 3
    assert [t.identity for t in Store(tmp_path).select("pretrain", 0)] == [t.identity for t in trajectories]


def test_checkpoints_round_trip_and_are_never_half_written(tmp_path, monkeypatch):
    path = tmp_path / "c.npz"
    old = Checkpoint({"model/w": np.arange(6.0).reshape(2, 3), "optimiser/0/step": np.array(3.0)}, {"version": 1})
    save_checkpoint(path, old)
    back = load_checkpoint(path)
    assert back.manifest == {"version": 1}
    np.testing.assert_array_equal(back.part("model")["w"], old.arrays["model/w"])
    assert set(back.part("optimiser")) == {"0/step"}

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(StoreError, match=r"c\.npz: could not be written \(No space left on device\)"):
        save_checkpoint(path, Checkpoint({}, {"version": 2}))
    assert load_checkpoint(path).manifest == {"version": 1}
    assert [f.name for f in tmp_path.iterdir()] == ["c.npz"]


def test_loading_a_hostile_checkpoint_executes_nothing(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "executed"), "w"))

    path = tmp_path / "bomb.npz"
    np.savez(path, manifest=np.array([Bomb()], dtype=object))
    with pytest.raises(StoreError, match="not a checkpoint"):
        load_checkpoint(path)
    assert not (tmp_path / "executed").exists()
    with pytest.raises(StoreError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "missing.npz")
