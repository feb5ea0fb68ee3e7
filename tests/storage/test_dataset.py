"""The dataset: durability, canonical order, damage; and checkpoints."""

import dataclasses
import hashlib
import os
import zlib
from typing import Any

import numpy as np
import pytest

from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.dataset import Damaged
from icrl_dist.storage.dataset import Dataset as RealDataset
from icrl_dist.storage.files import StoreError
from icrl_dist.storage.segment import FORMAT, HEADER_BYTES, NAME, SEAL_BYTES, TRAJECTORY, frame
from icrl_dist.storage.sharing import adopt
from icrl_dist.stream import wire
from icrl_dist.types import Identity
from tests.jobs import collected
from tests.stream import examples


@pytest.fixture
def trajectories(small_run):
    return collected(small_run, 2)


@pytest.fixture
def Dataset():  # noqa: N802 - replaces the class
    """Datasets that are closed when the test ends."""
    opened = []

    def make(*arguments, **options):
        opened.append(RealDataset(*arguments, **options))
        return opened[-1]

    yield make
    for dataset in opened:
        dataset.close()


def everything(dataset):
    """Every trajectory in the order in which a fit reads them: by variation, then by trial."""
    return [t for key in dataset.variations("pretrain", 0) for t in dataset.trials(key)]


def test_reopening_gives_the_appended_trajectories_in_canonical_order(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path)
    dataset.append(trajectories[5:])
    dataset.append(trajectories[:5])
    again = Dataset(tmp_path)
    assert len(again) == len(trajectories) and not again.damage
    assert [t.identity for t in everything(again)] == [t.identity for t in trajectories]
    for t in trajectories:
        back = again.read(t.identity)
        assert wire.trajectory_digest(back) == wire.trajectory_digest(t)
        assert (back.variation, back.worker, back.origin) == (t.variation, t.worker, t.origin)
        assert {n: a.dtype.str for n, a in back.arrays().items()} == {n: a.dtype.str for n, a in t.arrays().items()}
    assert trajectories[0].identity in again and Identity("adapt", 0, 0, 0, 0) not in again


def test_one_segment_may_hold_discrete_and_continuous_actions(Dataset, tmp_path, trajectories):
    t, rng = trajectories[0], np.random.default_rng(0)
    steps, queries, window_steps = len(t.actions), len(t.queries), len(t.prev_actions)
    shapes = {"actions": (steps, 3), "labels": (queries, 3), "prev_actions": (window_steps, 3), "adversary": (steps, 2)}
    arrays = {name: rng.uniform(-1, 1, shape).astype(np.float32) for name, shape in shapes.items()}
    vectors = [dataclasses.replace(t, identity=t.identity._replace(trial=100 + n), **arrays) for n in range(3)]
    Dataset(tmp_path).append([vectors[0], *trajectories, *vectors[1:]])
    again = Dataset(tmp_path)
    for one in (*trajectories, *vectors):
        back = again.read(one.identity)
        assert wire.trajectory_digest(back) == wire.trajectory_digest(one)
        assert {n: a.shape for n, a in back.arrays().items()} == {n: a.shape for n, a in one.arrays().items()}


def test_the_index_has_the_place_and_the_origin_of_each_trajectory(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path, seal_bytes=2000)
    for t in trajectories:
        dataset.append([dataclasses.replace(t, worker=f"w{t.identity.trial}", policy_version=3, weights_digest="d" * 64)])
    rows = list(dataset.index)
    assert [row.identity for row in rows] == [t.identity for t in trajectories]
    assert len({row.segment for row in rows}) > 2
    for row, t in zip(rows, trajectories, strict=True):
        assert (row.worker, row.policy_version, row.weights_digest, row.origin) == (
            f"w{t.identity.trial}",
            3,
            "d" * 64,
            "optimal",
        )
        assert row.sha256 == wire.trajectory_digest(dataset.read(row.identity)) and row == dataset.index[row.identity]
    first = trajectories[0].identity
    assert dataset.index.count("pretrain", 0) == len(trajectories) and dataset.index.count("adapt", 0) == 0
    assert dataset.index.identities("pretrain", 0, (0, 1)) == [t.identity for t in trajectories if t.identity.task == 0]
    assert len(dataset.index) == len(list(dataset.index)) == len(trajectories)
    assert (
        dataset.index.policy_versions("pretrain", 0, (0, 1)) == [3] and dataset.index.policy_versions("adapt", 0, (0, 1)) == []
    )
    with pytest.raises(KeyError):
        dataset.index[first._replace(stage="evaluate")]
    dataset.index.add(rows[:3])  # a second time: ignored
    dataset.index.drop(first[:4])
    left = [row for row in rows if row.identity[:4] != first[:4]]
    assert list(dataset.index) == left and len(dataset.index) == len(left) < len(rows)


def test_the_digest_depends_on_the_bytes_and_not_on_order_or_worker(Dataset, tmp_path, trajectories, small_run):
    one, two, three = (Dataset(tmp_path / name) for name in "abc")
    one.append(trajectories)
    others = collected(small_run, 2, "another worker")
    two.append(others[::-1])
    assert one.digest() == two.digest()
    changed = others[0].rewards.copy()
    changed[2] += 1
    three.append([dataclasses.replace(others[0], rewards=changed), *others[1:]])
    assert three.digest() != one.digest()


def test_a_dataset_is_little_larger_than_its_arrays(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path)
    t = trajectories[0]
    arrays = {n: np.repeat(a, 5, axis=0) if n != "observations" else a for n, a in t.arrays().items()}
    arrays["observations"] = np.zeros((len(arrays["actions"]) + 1, 2), np.float32)
    many = [dataclasses.replace(t, identity=t.identity._replace(trial=n), **arrays) for n in range(500)]
    dataset.append(many)
    raw = sum(a.nbytes for one in many for a in one.arrays().values())
    used = sum(f.stat().st_size for f in tmp_path.iterdir())
    assert raw < used < 1.1 * raw


def segment_of(folder):
    (path,) = folder.glob("segment-*")
    return path


def test_a_torn_tail_is_cut_off_and_reported(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path)
    dataset.append(trajectories)
    dataset.close()
    path = segment_of(tmp_path)
    whole = path.read_bytes()
    begins = len(whole) - (HEADER_BYTES + Dataset(tmp_path).index[trajectories[-1].identity].length)
    for cut in (len(whole) - 1, begins + 3, begins + HEADER_BYTES + 3):
        path.write_bytes(whole[:cut])
        torn = Dataset(tmp_path)
        assert torn.damage == [f"{path.name}: cut off a torn tail of {cut - begins} bytes at byte {begins}"]
        assert len(torn) == len(trajectories) - 1 and trajectories[-1].identity not in torn
        torn.append(trajectories[-1:])
        torn.close()
        assert path.read_bytes() == whole
    path.write_bytes(whole + bytes(1000))
    assert len(Dataset(tmp_path)) == len(trajectories), "a power cut can leave zeros at the end"


@pytest.mark.parametrize("sealed", [True, False])
def test_any_changed_byte_is_found_and_reported_and_costs_only_its_frame(Dataset, tmp_path, trajectories, sealed):
    dataset = Dataset(tmp_path / "whole")
    dataset.append(trajectories)
    if sealed:
        dataset.seal()
    rows = list(dataset.index)
    dataset.close()
    whole = segment_of(tmp_path / "whole").read_bytes()
    rng = np.random.default_rng(0)
    for at in [3, 5, *rng.integers(0, len(whole), 60).tolist()]:
        folder = tmp_path / f"{at}"
        folder.mkdir()
        changed = bytearray(whole)
        changed[at] ^= 1 << int(rng.integers(8))
        (folder / "segment-000000.frames").write_bytes(changed)
        unchanged = Dataset(folder, readonly=True)
        assert segment_of(folder).read_bytes() == changed and unchanged.damage
        repaired_dataset = Dataset(folder)
        assert repaired_dataset.damage and "segment-000000.frames" in repaired_dataset.damage[0], at
        lost = [r.identity for r in rows if r.identity not in repaired_dataset]
        hit = [r.identity for r in rows if r.offset - HEADER_BYTES <= at < r.offset + r.length]
        assert lost == hit or (not hit and len(lost) in (0, len(lost))), at
        by_identity = {t.identity: t for t in trajectories}
        repaired_dataset.append([by_identity[i] for i in lost])
        repaired_dataset.close()
        again = Dataset(folder)
        assert not again.damage and list(again.index.digests()) == [r.sha256 for r in rows], at
        again.close()


def test_a_damaged_name_costs_the_trajectories_that_refer_to_it(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path)
    dataset.append(trajectories)
    dataset.close()
    path = segment_of(tmp_path)
    damaged = bytearray(path.read_bytes())
    damaged[HEADER_BYTES + 2] ^= 1  # the first name: the first task's only variation
    path.write_bytes(damaged)
    repaired_dataset = Dataset(tmp_path)
    first = [t.identity for t in trajectories if t.variation == trajectories[0].variation]
    assert [t.identity for t in trajectories if t.identity not in repaired_dataset] == first
    assert "whose names were damaged" in repaired_dataset.damage[1] and str(len(first)) in repaired_dataset.damage[1]
    repaired_dataset.append([t for t in trajectories if t.identity in first])
    assert [t.identity for t in everything(Dataset(tmp_path))] == [t.identity for t in trajectories]


def test_damage_of_an_open_dataset_is_found_when_it_is_read(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path)
    dataset.append(trajectories)
    dataset.seal()
    row = dataset.index[trajectories[2].identity]
    with segment_of(tmp_path).open("r+b") as file:
        file.seek(row.offset + 20)
        file.write(b"\xff\xfe")
    with pytest.raises(Damaged, match=rf"segment-000000.frames: damaged at byte {row.offset}, in {row.identity}"):
        everything(dataset)
    assert "damaged range" in dataset.repair()[0]
    assert [t.identity for t in trajectories if t.identity not in dataset] == [row.identity]
    dataset.append([trajectories[2]])
    assert len(everything(dataset)) == len(trajectories)


def test_segments_are_sealed_at_their_size_and_never_change_afterwards(Dataset, tmp_path, trajectories):
    dataset = Dataset(tmp_path, seal_bytes=1000)
    for t in trajectories:
        dataset.append([t])
    dataset.seal()
    dataset.seal()
    files = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    assert len(files) > 3
    for item in dataset.manifest():
        content = files[item["segment"]]
        assert item["bytes"] == len(content)
        assert item["sha256"] == hashlib.sha256(content[:-SEAL_BYTES]).hexdigest() == content[-32:].hex()
    assert len(dataset.manifest()) == len(files)
    again = Dataset(tmp_path)
    assert again.manifest() == dataset.manifest()
    extra = dataclasses.replace(trajectories[0], identity=Identity("adapt", 0, 0, 0, 0))
    again.append([extra])
    assert {name: (tmp_path / name).read_bytes() for name in files} == files
    assert [t.identity for t in everything(Dataset(tmp_path))] == [t.identity for t in trajectories]


def test_on_a_full_disk_a_call_stores_nothing_and_its_error_has_the_remedy(Dataset, tmp_path, trajectories, monkeypatch):
    dataset = Dataset(tmp_path)
    dataset.append(trajectories[:3])
    before = segment_of(tmp_path).read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(StoreError, match=r"segment-000000.frames: could not be written \(No space.*--resume"):
            dataset.append(trajectories[3:])
    assert len(dataset) == 3 and segment_of(tmp_path).read_bytes() == before
    dataset.append(trajectories[3:])
    assert len(Dataset(tmp_path)) == len(trajectories)


def test_intact_frames_with_invalid_content_are_refused(Dataset, tmp_path):
    for content in (frame(NAME, b"\xc1"), frame(TRAJECTORY, b"\x93\x01\x02\x03"), frame(NAME, b"\x00\x93\x01\x02\x03")):
        (tmp_path / "segment-000000.frames").write_bytes(content)
        with pytest.raises(StoreError, match=r"segment-000000\.frames: not a dataset of this version"):
            Dataset(tmp_path)
    (tmp_path / "segment-000000.frames").unlink()
    (tmp_path / "segment-x.frames").write_bytes(b"")
    with pytest.raises(StoreError, match=r"segment-x\.frames"):
        Dataset(tmp_path)


def in_format(content, number):
    """The frames of a segment as another format writes them: formats differ in the third byte of each frame."""
    other, at = bytearray(content), 0
    while at < len(other):
        other[at + 2 : at + 3] = number
        other[at + 12 : at + 16] = zlib.crc32(other[at : at + 12]).to_bytes(4, "little")
        at += HEADER_BYTES + int.from_bytes(other[at + 4 : at + 8], "little")
    return bytes(other)


FORMER = {
    "sealed": lambda content: content,
    "torn": lambda content: content[:-50],
    "first header damaged": lambda content: b"x" + content[1:],
    "after a frame of today": lambda content: frame(TRAJECTORY, b"") + content,
}


@pytest.mark.parametrize("change", FORMER)
@pytest.mark.parametrize(("number", "shown"), [(b"r", 1), (b"9", 9)])
def test_a_dataset_of_another_format_is_refused_in_one_line_and_not_repaired(
    Dataset, tmp_path, trajectories, number, shown, change
):
    dataset = Dataset(tmp_path / "run")
    dataset.append(trajectories)
    dataset.seal()
    path = segment_of(tmp_path / "run")
    assert in_format(path.read_bytes(), b"2") == path.read_bytes()
    path.write_bytes(FORMER[change](in_format(path.read_bytes(), number)))
    before = path.read_bytes()
    message = f"{path}: dataset format {shown}, this release reads 2: use the release that wrote it, or start a new run"
    for read in (
        lambda: Dataset(tmp_path / "run"),
        lambda: Dataset(tmp_path / "run", readonly=True),
        lambda: adopt(tmp_path / "run", tmp_path / "fork", keep=lambda _: True),
    ):
        with pytest.raises(StoreError) as refused:
            read()
        assert str(refused.value) == message
    assert path.read_bytes() == before and [f.name for f in path.parent.iterdir()] == [path.name]
    assert not list((tmp_path / "fork").iterdir())


def test_whoever_changes_the_digest_of_a_trajectory_raises_the_numbers_of_segments_and_messages():
    """A reader of the former numbers would give the same bytes another digest, so these three change together."""
    t = examples.trajectory()
    zeros: dict[str, Any] = {name: np.zeros_like(array) for name, array in t.arrays().items()}
    digest = wire.trajectory_digest(dataclasses.replace(t, **zeros))
    assert (FORMAT, wire.VERSION, digest[:16]) == (2, 2, "c8a38d1bb2bebbc2")


def is_early(identity):
    return identity.task == 0


def test_segments_of_another_run_are_shared_without_unwanted_trajectories(Dataset, tmp_path, trajectories):
    parent = Dataset(tmp_path / "parent")
    early = [t for t in trajectories if is_early(t.identity)]
    late = [t for t in trajectories if not is_early(t.identity)]
    for part in (early[:3], late[:3], early[3:5] + late[3:], early[5:]):
        parent.append(part)
        if part[0] is not early[5]:
            parent.seal()
    manifest = parent.manifest()
    bytes_shared = adopt(parent.folder, tmp_path / "fork", keep=is_early)
    fork = Dataset(tmp_path / "fork")
    assert [t.identity for t in everything(fork)] == [t.identity for t in early]
    assert bytes_shared == manifest[0]["bytes"]
    linked = {f.name: f.samefile(parent.folder / f.name) for f in sorted((tmp_path / "fork").iterdir())}
    assert linked == {f"segment-{n:06d}.frames": n == 0 for n in (0, 1, 2)}
    fork.append([dataclasses.replace(trajectories[0], identity=Identity("adapt", 0, 0, 0, 0))])
    assert Dataset(parent.folder, readonly=True).manifest() == manifest, "what the fork appends does not change the parent"
    one = parent.folder / "segment-000000.frames"
    one.write_bytes(one.read_bytes()[:-10] + b"0123456789")
    with pytest.raises(StoreError, match="damaged, so it cannot be shared"):
        adopt(parent.folder, tmp_path / "third", keep=is_early)


def test_checkpoints_round_trip_and_are_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "c.npz"
    old = Checkpoint({"model/w": np.arange(6.0).reshape(2, 3), "optimizer/0/step": np.array(3.0)}, {"version": 1})
    save_checkpoint(path, old)
    back = load_checkpoint(path)
    assert back.manifest == {"version": 1}
    np.testing.assert_array_equal(back.part("model")["w"], old.arrays["model/w"])
    assert set(back.part("optimizer")) == {"0/step"}

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(StoreError, match=r"c\.npz: could not be written \(No space left on device\)"):
        save_checkpoint(path, Checkpoint({}, {"version": 2}))
    assert load_checkpoint(path).manifest == {"version": 1}
    assert [f.name for f in tmp_path.iterdir()] == ["c.npz"]
