"""Experts as files of stable-baselines3, in both directions."""

import base64
import contextlib
import dataclasses
import io
import json
import os
import pickle
import zipfile
from typing import Any

import gymnasium
import numpy as np
import pytest
import stable_baselines3
import torch

from icrl_dist.experts.sac.batched import SACBatch
from icrl_dist.experts.sac.draws import update_draws
from icrl_dist.experts.sac.sb3_expert import Expert
from icrl_dist.types import Step
from tests.experts.sac_cases import SMALL, SPEC, A, N, S, Spaces, random_updates, through_file, updated_by_sb3


def test_a_file_opens_in_stable_baselines3_and_gives_the_same_actions(tmp_path):
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    for batch, noise in random_updates(SMALL, 5):
        engine.update(batch, noise)
    observations = np.random.default_rng(0).normal(size=(N, 7, S)).astype(np.float32)
    actions = engine.act(observations)
    assert actions.shape == (N, 7, A)
    np.testing.assert_allclose(engine.act(observations[:, 0]), actions[:, 0], atol=1e-6)
    for index in range(N):
        model = through_file(engine, index, tmp_path / "expert.zip")
        np.testing.assert_allclose(model.predict(observations[index], deterministic=True)[0], actions[index], atol=1e-6)
        assert model._n_updates == 5


def test_files_are_read_back_unchanged_and_after_updates_by_stable_baselines3(tmp_path, monkeypatch):
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    for batch, noise in random_updates(SMALL, 5):
        engine.update(batch, noise)
    paths = [tmp_path / f"{index}.zip" for index in range(N)]
    for index, path in enumerate(paths):
        engine.save_sb3(index, path)
        again = updated_by_sb3(Expert.load(path, device="cpu"), index, random_updates(SMALL, 5, seed=1), monkeypatch)
        again.save(tmp_path / f"later-{index}.zip")
    other = SACBatch(range(7, 7 + N), SPEC, SMALL, "cpu")
    other.load_sb3(paths)
    assert other.updates == 5
    for name, array in engine.arrays.items():
        assert torch.equal(other.arrays[name], array), name
    for batch, noise in random_updates(SMALL, 5, seed=1):
        other.update(batch, noise)
    engine.load_sb3([tmp_path / f"later-{index}.zip" for index in range(N)])
    assert engine.updates == other.updates == 10
    for name, array in engine.arrays.items():
        torch.testing.assert_close(other.arrays[name], array, atol=2e-5, rtol=1e-3)


def test_an_expert_without_updates_is_read_back_too(tmp_path):
    engine, other = SACBatch([0], SPEC, SMALL, "cpu"), SACBatch([1], SPEC, SMALL, "cpu")
    engine.save_sb3(0, tmp_path / "first.zip")
    other.load_sb3([tmp_path / "first.zip"])
    assert other.updates == 0 and all(torch.equal(other.arrays[name], array) for name, array in engine.arrays.items())


def test_files_of_another_shape_number_of_updates_or_kind_are_refused(tmp_path):
    engine = SACBatch(range(2), SPEC, SMALL, "cpu")
    paths = [tmp_path / "0.zip", tmp_path / "1.zip"]
    engine.save_sb3(0, paths[0])
    with pytest.raises(ValueError, match="1 files for 2 experts"):
        engine.load_sb3(paths[:1])
    for batch, noise in random_updates(SMALL, 1, experts=2):
        engine.update(batch, noise)
    engine.save_sb3(1, paths[1])
    with pytest.raises(ValueError, match=r"after \[0, 1\] updates"):
        engine.load_sb3(paths)
    wide = SACBatch([0], SPEC, dataclasses.replace(SMALL, hidden=(16, 9)), "cpu")
    with pytest.raises(ValueError, match=r"hidden layers \[16, 8\], not 17, 6 and \(16, 9\)"):
        wide.load_sb3(paths[:1])
    fixed = stable_baselines3.SAC(
        "MlpPolicy", Spaces(), policy_kwargs={"net_arch": [16, 8]}, ent_coef=0.1, buffer_size=1, device="cpu"
    )
    fixed.save(paths[0])
    with pytest.raises(ValueError, match="temperature is fixed"):
        SACBatch([0], SPEC, SMALL, "cpu").load_sb3(paths[:1])
    for low, activation, words in (
        (-1, torch.nn.Tanh, "with activation Tanh .* train it with ReLU"),
        (-2, torch.nn.ReLU, r"actions from \[-2.0.* rescaled to \[-1, 1\]"),
    ):
        spaces = Spaces()
        spaces.action_space = gymnasium.spaces.Box(low, 1, (A,), np.float32)
        kinds = {"net_arch": [16, 8], "activation_fn": activation}
        stable_baselines3.SAC("MlpPolicy", spaces, policy_kwargs=kinds, buffer_size=1, device="cpu").save(paths[0])
        with pytest.raises(ValueError, match=words):
            SACBatch([0], SPEC, SMALL, "cpu").load_sb3(paths[:1])


def test_the_global_generators_do_not_change(tmp_path):
    torch.manual_seed(3)
    before = torch.get_rng_state(), np.random.get_state(legacy=False)["state"]["key"].tolist()
    engine = SACBatch([0], SPEC, SMALL, "cpu")
    engine.save_sb3(0, tmp_path / "expert.zip")
    engine.load_sb3([tmp_path / "expert.zip"])
    observation, action = np.ones((1, S), np.float32), np.ones((1, A), np.float32)
    engine.store(observation, action, Step(observation, np.ones(1, np.float32), False, np.zeros((1, 2), np.float32)))
    ((picks, noise),) = update_draws([0], 0, (SMALL.batch, A), 1, torch.device("cpu"))
    engine.update_from_replay(picks, noise)
    assert (
        torch.equal(before[0], torch.get_rng_state())
        and before[1] == np.random.get_state(legacy=False)["state"]["key"].tolist()
    )


class Bomb:
    """An object that creates a folder when it is unpickled."""

    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return os.mkdir, (self.marker,)


def encoded(value):
    return base64.b64encode(pickle.dumps(value)).decode()


def rewritten(source, target, **members):
    """The file with some members replaced; None removes a member."""
    with zipfile.ZipFile(source) as before, zipfile.ZipFile(target, "w") as after:
        contents = {name: before.read(name) for name in before.namelist()} | members
        for name, content in contents.items():
            if content is not None:
                after.writestr(name, content)
    return target


def torch_pickle(value):
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def test_a_file_of_others_executes_nothing(tmp_path):
    engine, marker = SACBatch([0], SPEC, SMALL, "cpu"), tmp_path / "executed"
    whole, bomb = tmp_path / "whole.zip", Bomb(marker)
    engine.save_sb3(0, whole)
    data = json.loads(zipfile.ZipFile(whole).read("data"))
    for name in [name for name, value in data.items() if isinstance(value, dict) and ":serialized:" in value]:
        data[name][":serialized:"] = encoded(bomb)
    hostile = rewritten(whole, tmp_path / "hostile.zip", data=json.dumps(data))
    other = SACBatch([1], SPEC, SMALL, "cpu")
    other.load_sb3([hostile])
    assert all(torch.equal(other.arrays[name], array) for name, array in engine.arrays.items())
    for member in [name for name in zipfile.ZipFile(whole).namelist() if name.endswith(".pth")]:
        for content in (pickle.dumps(bomb, 2), torch_pickle(bomb), torch_pickle({"x": bomb})):
            hostile = rewritten(whole, tmp_path / "hostile.zip", **{member: content})
            with pytest.raises(ValueError, match="can be read"):
                other.load_sb3([hostile])
    assert not marker.exists()
    hostile = rewritten(whole, tmp_path / "hostile.zip", data=json.dumps(data))
    with contextlib.suppress(Exception):
        stable_baselines3.SAC.load(hostile, device="cpu")
    assert marker.exists(), "the file does execute code where it is unpickled"


def test_malformed_files_are_refused_with_their_name(tmp_path):
    engine, whole = SACBatch([0], SPEC, SMALL, "cpu"), tmp_path / "whole.zip"
    engine.save_sb3(0, whole)
    spare = torch_pickle({"log_ent_coef": torch.zeros(3)})
    changes: list[dict[str, Any]] = [{"data": data} for data in (b"{", b"[]", b"{}", None)]
    changes += [{"policy.pth": content} for content in (None, spare)]
    changes += [{"pytorch_variables.pth": content} for content in (None, spare)]
    changes += [{"actor.optimizer.pth": spare}]
    for change in changes:
        with pytest.raises(ValueError, match=r"broken\.zip is no file .* save it again"):
            engine.load_sb3([rewritten(whole, tmp_path / "broken.zip", **change)])
    (tmp_path / "broken.zip").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"broken\.zip is no file"):
        engine.load_sb3([tmp_path / "broken.zip"])
    with zipfile.ZipFile(tmp_path / "broken.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("data", bytes(1 << 24))
    with pytest.raises(ValueError, match="more than its own size"):
        engine.load_sb3([tmp_path / "broken.zip"])
