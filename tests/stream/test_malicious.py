"""Untrusted files: nothing in them is executed, and every error is a StoreError or ConfigError."""

import contextlib
import dataclasses
import io
import json
import os
import pickle
import zipfile

import msgpack
import numpy as np
import pytest

from icrl_dist import load_agent
from icrl_dist.config import run
from icrl_dist.config.run import ConfigError
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry
from icrl_dist.storage import segment
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, version_file
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from tests.jobs import collected


class Bomb:
    """An object that creates a folder when it is unpickled."""

    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return os.mkdir, (self.marker,)


@pytest.fixture
def bomb(tmp_path):
    """An object that executes code when unpickled; the test fails if the code has run."""
    marker = tmp_path / "executed"
    pickle.loads(pickle.dumps(Bomb(marker)))
    marker.rmdir()
    yield Bomb(marker)
    assert not marker.exists()


@pytest.fixture
def agent(small_run):
    """The arrays and the manifest of a valid checkpoint for load_agent."""
    spec = registry.of(small_run).spec
    model = PretrainedTransformer(spec, small_run.model)
    arrays = {f"model/{name}": value.detach().numpy() for name, value in model.state_dict().items()}
    return arrays, {"run": run.dumps(small_run), "spec": dataclasses.asdict(spec)}


def as_npy(value):
    file = io.BytesIO()
    np.save(file, value, allow_pickle=True)
    return file.getvalue()


def header(shape, dtype="<f4"):
    """An array file with this shape in its header and sixteen bytes of content."""
    file = io.BytesIO()
    np.lib.format.write_array_header_2_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue() + bytes(16)


def checkpoint(path, members, compression=zipfile.ZIP_STORED):
    """A checkpoint made by hand: a zip file of these members and, unless given, a valid manifest and array."""
    good = {"manifest.npy": as_npy(np.frombuffer(b'{"version": 1}', np.uint8)), "a/model/w.npy": as_npy(np.zeros(3))}
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in {**good, **members}.items():
            file.writestr(name, content)


CHECKPOINTS = {
    "an object array as the manifest": lambda bomb: {"manifest.npy": as_npy(np.array([bomb], dtype=object))},
    "an object array among the arrays": lambda bomb: {"a/model/w.npy": as_npy(np.array([bomb], dtype=object))},
    "a structured array with an object in it": lambda bomb: {"a/w.npy": as_npy(np.array([(1, bomb)], dtype="i4,O"))},
    "a pickle in place of an array": lambda bomb: {"a/model/w.npy": pickle.dumps(bomb)},
    "a pickle in place of the manifest": lambda bomb: {"manifest.npy": pickle.dumps(bomb)},
    "an object array's header before a pickle": lambda bomb: {"a/w.npy": header((1,), "|O")[:-16] + pickle.dumps(bomb)},
    "code in an array's header": lambda bomb: {"a/w.npy": code_in_header(bomb)},
    "code in place of JSON": lambda bomb: {"manifest.npy": as_npy(np.frombuffer(code(bomb).encode(), np.uint8))},
    "JSON nested without end": lambda _: {"manifest.npy": as_npy(np.frombuffer(b"[" * 200_000, np.uint8))},
    "a manifest that is a list": lambda _: {"manifest.npy": as_npy(np.frombuffer(b"[1, 2]", np.uint8))},
    "a manifest that is null": lambda _: {"manifest.npy": as_npy(np.frombuffer(b"null", np.uint8))},
    "an array that claims terabytes": lambda _: {"a/model/w.npy": header((1 << 50,))},
    "a manifest that claims terabytes": lambda _: {"manifest.npy": header((1 << 50,), "|u1")},
    "a negative shape": lambda _: {"a/model/w.npy": header((-1, 4))},
}


def code(bomb):
    return f"__import__('os').mkdir({bomb.marker!r})"


def code_in_header(bomb):
    text = f"{{'descr': {code(bomb)}, 'fortran_order': False, 'shape': (1,)}}".encode()
    return b"\x93NUMPY\x02\x00" + len(text).to_bytes(4, "little") + text


@pytest.mark.parametrize("where", ["a checkpoint", "a run folder"])
@pytest.mark.parametrize("what", CHECKPOINTS)
def test_a_malicious_checkpoint(tmp_path, bomb, what, where):
    folder = tmp_path / "run"
    file = version_file(folder, 3)
    checkpoint(file, CHECKPOINTS[what](bomb))
    with pytest.raises(StoreError, match="not a checkpoint of this system"):
        load_checkpoint(file)
    with pytest.raises(StoreError, match="not a checkpoint of this system"):
        load_agent(folder if where == "a run folder" else file)


def test_a_zip_bomb(tmp_path):
    big = {"a/model/w.npy": as_npy(np.zeros(1 << 22, np.uint8))}
    checkpoint(tmp_path / "flat.npz", big)
    assert load_checkpoint(tmp_path / "flat.npz").arrays["model/w"].size == 1 << 22
    checkpoint(tmp_path / "bomb.npz", big, zipfile.ZIP_DEFLATED)
    with pytest.raises(StoreError, match=r"not a checkpoint of this system \(\d+ bytes that would unpack to \d+\)"):
        load_checkpoint(tmp_path / "bomb.npz")


def test_the_checkpoint_without_a_malicious_member_is_valid(tmp_path):
    checkpoint(tmp_path / "c.npz", {})
    assert load_checkpoint(tmp_path / "c.npz").manifest == {"version": 1}


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_a_pickle_named_as_a_checkpoint(tmp_path, bomb, protocol):
    file = tmp_path / "version-0000.npz"
    file.write_bytes(pickle.dumps(bomb, protocol))
    with pytest.raises(StoreError, match="not a checkpoint"):
        load_agent(file)


def test_a_torch_file_named_as_a_checkpoint(tmp_path, bomb):
    import torch

    torch.save({"model": bomb}, tmp_path / "agent.npz")
    with pytest.raises(StoreError, match="not a checkpoint"):
        load_agent(tmp_path / "agent.npz")


def test_missing_empty_and_garbage_files(tmp_path):
    with pytest.raises(StoreError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "missing.npz")
    with pytest.raises(ConfigError, match="no such run folder or checkpoint"):
        load_agent(tmp_path / "missing.npz")
    for content in (b"", b"garbage", b"PK\x03\x04garbage", bytes(1000)):
        (tmp_path / "agent.npz").write_bytes(content)
        with pytest.raises(StoreError, match="not a checkpoint"):
            load_agent(tmp_path / "agent.npz")


RUNS = {
    "code as a value": lambda bomb: f"seed = {code(bomb)}",
    "code as a string": lambda bomb: f"[learner]\ndevice = {json.dumps(code(bomb))}",
    "a method that is code": lambda bomb: f"method = {json.dumps(code(bomb))}",
    "a key that is a Python attribute": lambda _: "__class__ = 1",
    "a section that is a Python attribute": lambda _: "[__init__]\n__globals__ = 1",
    "a number of ten thousand digits": lambda _: "seed = " + "9" * 10_000,
    "lists nested without end": lambda _: "seed = " + "[" * 100_000,
    "tables in tables in tables": lambda _: "a" + ".a" * 3_000 + " = 1",
    "a model without end": lambda _: "[model]\nwidth = 1000000000000\nheads = 1",
}


@pytest.mark.parametrize("what", RUNS)
def test_a_malicious_run(tmp_path, bomb, agent, what):
    file = tmp_path / "run.toml"
    file.write_text(RUNS[what](bomb))
    if what != "a model without end":  # valid until the model is built
        with pytest.raises(ConfigError) as caught:
            run.load(str(file))
        assert str(caught.value).startswith(f"run file '{file}'") or str(caught.value).startswith(str(file))
    arrays, manifest = agent
    save_checkpoint(tmp_path / "agent.npz", Checkpoint(arrays, {**manifest, "run": file.read_text()}))
    with pytest.raises(StoreError, match="not an agent of this version"):
        load_agent(tmp_path / "agent.npz")


MANIFESTS = {
    "a run that is a number": lambda good: {**good, "run": 7},
    "a run that is a table": lambda good: {**good, "run": {"seed": 1}},
    "a spec that is a string": lambda good: {**good, "spec": "low"},
    "a spec of strings": lambda good: {**good, "spec": {**good["spec"], "low": "abc"}},
    "a spec without end": lambda good: {**good, "spec": {**good["spec"], "actions": 1 << 60}},
    "negative actions": lambda good: {**good, "spec": {**good["spec"], "actions": -1}},
}


@pytest.mark.parametrize("what", MANIFESTS)
def test_an_invalid_manifest(tmp_path, agent, what):
    arrays, manifest = agent
    save_checkpoint(tmp_path / "good.npz", Checkpoint(arrays, manifest))
    assert load_agent(tmp_path / "good.npz").manifest["run"] == manifest["run"]
    save_checkpoint(tmp_path / "agent.npz", Checkpoint(arrays, MANIFESTS[what](manifest)))
    with pytest.raises(StoreError, match="not an agent of this version"):
        load_agent(tmp_path / "agent.npz")


def test_a_run_folder_with_pickles_in_every_file_but_the_checkpoint(tmp_path, bomb, agent):
    folder = tmp_path / "run"
    save_checkpoint(version_file(folder, 0), Checkpoint(*agent))
    others = ["run.toml", "env.json", "metrics.jsonl", "result.json", "endpoint", "learner.log", "index.db", "__init__.py"]
    for name in [*others, "conftest.py", "dataset/segment-000000.frames", "dataset/index", "sitecustomize.py", "torch.py"]:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(code(bomb).encode() if name.endswith(".py") else pickle.dumps(bomb))
    for name in ("version-evil.npz", "version-99999.npz", "version-9999.pkl", "version--001.npz"):
        (folder / "checkpoints" / name).write_bytes(pickle.dumps(bomb))
    with pytest.raises(ConfigError, match=r"run\.toml'?: cannot be read"):
        load_agent(folder)
    (folder / "run.toml").unlink()
    agent = load_agent(folder)
    agent.reset_context(batch=2)
    assert agent.act(np.zeros((2, 2))).shape == (2,)


SEGMENTS = {
    "a pickle": lambda bomb: pickle.dumps(bomb),
    "an array file of objects": lambda bomb: as_npy(np.array([bomb], dtype=object)),
    "code": lambda bomb: code(bomb).encode(),
    "noise": lambda _: np.random.default_rng(0).bytes(5000),
    "zeros": lambda _: bytes(5000),
    "another database": lambda _: b"SQLite format 3\x00" + bytes(4080),
    "a name that is a pickle": lambda bomb: segment.frame(segment.NAME, pickle.dumps(bomb)),
    "a trajectory that is a pickle": lambda bomb: segment.frame(segment.TRAJECTORY, pickle.dumps(bomb)),
    "a name of an unknown type": lambda bomb: segment.frame(
        segment.NAME, msgpack.packb(msgpack.ExtType(5, pickle.dumps(bomb)))
    ),
    "a name nested without end": lambda _: segment.frame(segment.NAME, b"\x00" + b"\x91" * 100_000),
    "a trajectory that claims terabytes": lambda _: segment.frame(segment.TRAJECTORY, msgpack.packb([0] * 10 + [1 << 30] * 4)),
}


@pytest.fixture
def dataset(tmp_path, small_run):
    """A valid dataset: its file and its number of trajectories."""
    with contextlib.closing(Dataset(tmp_path / "dataset")) as dataset:
        dataset.append(collected(small_run, 1))
        count = len(dataset)
    (file,) = (f for f in (tmp_path / "dataset").iterdir() if f.stat().st_size)
    return file, count


@pytest.mark.parametrize("what", SEGMENTS)
@pytest.mark.parametrize("after_valid", [False, True], ids=["alone", "after valid frames"])
def test_a_malicious_dataset(bomb, dataset, what, after_valid):
    file, count = dataset
    file.write_bytes((file.read_bytes() if after_valid else b"") + SEGMENTS[what](bomb))
    try:
        dataset = Dataset(file.parent)
    except StoreError as error:
        assert str(file) in str(error)
        return
    with contextlib.closing(dataset):
        assert len(dataset) == (count if after_valid else 0)
        assert dataset.damage, "it neither raised an error nor reported a repair"
