"""``explain``, ``evaluate``, ``export`` and ``load_agent`` of damaged run folders: each damaged file is named."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from icrl_dist import load_agent
from icrl_dist.cli import main
from icrl_dist.config.run import Run, dumps, override
from icrl_dist.storage.checkpoint import version_file
from icrl_dist.storage.dataset import segment_path
from icrl_dist.storage.files import StoreError
from tests.learner.test_recovery import flip
from tests.learner.test_service import no_tensorboard, parent

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard", "parent"]


@pytest.fixture
def damaged(parent, tmp_path):
    return shutil.copytree(parent[0], tmp_path / "run")


def explained(folder: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, list[str], list[str]]:
    code = main.main(["explain", str(folder), *more])
    out, err = capsys.readouterr()
    return code, out.splitlines(), err.splitlines()


def test_an_intact_folder_has_no_damage(parent, capsys):
    code, out, err = explained(parent[0], capsys)
    assert code == 0 and not err and len(out) == parent[1]["trajectories"]
    assert json.loads(out[0])["identity"] == "pretrain/0/0/0/0"


def gone(folder: Path) -> None:
    for path in (folder / "dataset").iterdir():
        path.unlink()


DAMAGE = {
    "a segment is missing": (lambda f: segment_path(f / "dataset", 1).unlink(), "segment-000001.frames: is missing"),
    "the last segment is missing": (lambda f: segment_path(f / "dataset", 2).unlink(), "segment-000002.frames: is missing"),
    "all segments are missing": (gone, "segment-000000.frames: is missing"),
    "the dataset is missing": (lambda f: shutil.rmtree(f / "dataset"), "its trajectories are not those that T^2 was fitted to"),
    "a segment is garbage": (lambda f: segment_path(f / "dataset", 0).write_bytes(b"x" * 999), "a damaged range of 999 bytes"),
    "a segment is empty": (lambda f: os.truncate(segment_path(f / "dataset", 0), 0), "its end is missing after byte 0"),
    "a segment is cut": (lambda f: os.truncate(segment_path(f / "dataset", 2), 9000), "segment-000002.frames: a torn tail"),
    "a bit of a segment is flipped": (lambda f: flip(segment_path(f / "dataset", 1), 9000), "segment-000001.frames: a damaged"),
    "a bit of a checkpoint is flipped": (lambda f: flip(version_file(f, 1), 3000), "version-0001.npz: not a checkpoint"),
    "a checkpoint is missing": (lambda f: version_file(f, 0).unlink(), "version-0000.npz: no such checkpoint"),
    "a checkpoint is a copy": (
        lambda f: shutil.copy(version_file(f, 1), version_file(f, 2)),
        "version-0002.npz: holds T^1, not",
    ),
    "env.json is garbage": (lambda f: (f / "env.json").write_text("{"), "env.json: damaged"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_explain_names_each_damaged_file(damaged, capsys, what):
    damage, expected = DAMAGE[what]
    damage(damaged)
    code, _, err = explained(damaged, capsys)
    assert code == 1 and any(expected in line for line in err), err
    assert all(line.startswith(f"icrl-dist: {damaged}") for line in err)


def test_explain_of_a_lost_trajectory_names_the_damage(damaged, capsys):
    gone(damaged)
    code, _, err = explained(damaged, capsys, "adapt/0/1/0/0")
    assert code == 1 and "has no trajectory adapt/0/1/0/0" in err[0] and "segment-000000.frames: is missing" in err[0]


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_explain_refuses_an_odd_file_by_name(damaged, capsys, kind):
    path = segment_path(damaged / "dataset", 1)
    path.unlink()
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    code, _, err = explained(damaged, capsys)
    assert code != 0 and str(path) in err[0] and len(err) == 1


def other_seed(folder: Path, run: Run) -> None:
    (folder / "run.toml").write_text(dumps(override(run, ["seed=5"], "--set")))


def test_evaluate_export_and_load_agent_hold_the_checkpoint_to_its_run(parent, damaged, tmp_path, capsys):
    def refusal(*command: str) -> str:
        assert main.main([*command]) == 1
        return capsys.readouterr().err

    shutil.copy(version_file(damaged, 1), version_file(damaged, 2))
    for command in (("evaluate", str(damaged)), ("export", str(damaged)), ("evaluate", str(version_file(damaged, 2)))):
        assert f"{version_file(damaged, 2)}: holds T^1, not T^2" in refusal(*command)
    with pytest.raises(StoreError, match="holds T"):
        load_agent(damaged)
    version_file(damaged, 2).unlink()
    other_seed(damaged, parent[2])
    assert "is of a run with other settings, seed = 0 (run.toml: 5)" in refusal("export", str(damaged))
    shutil.copy(version_file(parent[0], 1), tmp_path / "version-0007.npz")  # a file elsewhere has no run
    assert main.main(["export", str(tmp_path / "version-0007.npz"), "--out", str(tmp_path / "agent.npz")]) == 0
