"""A kill at any file operation of the beginning of a run: afterwards the same command begins it, and messages are true."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from icrl_dist.config.run import ConfigError, Run, dumps, load_folder
from icrl_dist.launch import run_folder, train
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.fork import Lineage
from icrl_dist.storage.held import opened
from tests.learner.test_service import no_tensorboard, parent

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard", "parent"]


@pytest.fixture(scope="module", params=["new", "fork"])
def beginnings(request, parent, tmp_path_factory):
    """The folder of run folders that kills left, how many, the run, and the source of the fork."""
    return left_by_kills(parent, tmp_path_factory.mktemp("killed"), "new", request.param == "fork")


def left_by_kills(parent, folder, what, is_fork):
    (folder / "small.toml").write_text(dumps(parent[2]))
    arguments = [str(folder), str(folder / "small.toml"), what, *([str(parent[0])] if is_fork else [])]
    done = subprocess.run(
        [sys.executable, "-m", "tests.launch.killed", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return folder, int(done.stdout), parent[2], (parent[0], 1) if is_fork else None


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def check(folder: Path, run: Run, source: tuple[Path, int] | None) -> None:
    """The run in the folder is complete."""
    assert load_folder(folder) == run and not list(folder.rglob("*.part")) and not (folder / ".beginning").exists()
    assert (folder / "env.json").read_text() == '{\n "sessions": []\n}\n'
    if source is not None:
        manifest = opened(folder, source[1], Lineage.of(folder, run)).manifest
        store = Dataset(folder / "dataset", readonly=True)
        assert store.digest(source[1]) == manifest["dataset_digest"] and not store.damage
        store.close()


OPTIONS = {"plain": (False, False), "resume": (True, False), "overwrite": (False, True)}


@pytest.mark.parametrize("option", OPTIONS)
def test_after_a_kill_at_any_operation_the_command_begins_the_run(beginnings, tmp_path, option):
    folder_of_all, count, run, source = beginnings
    resume, overwrite = OPTIONS[option]
    assert count > 8
    for operation in range(count + 1):
        folder = tmp_path / str(operation) / "run"
        left = folder_of_all / str(operation)
        left.mkdir(exist_ok=True)  # killed before it made a folder
        shutil.copytree(left, folder.parent)
        complete = (folder / "run.toml").exists() and not (folder / ".beginning").exists()
        if complete and option == "plain":
            with pytest.raises(ConfigError, match="exists: use --resume to continue the run, --overwrite"):
                train.prepare(run, folder, False, False, source)
            train.prepare(run, folder, True, False, source)
        elif not complete and option == "resume":
            with pytest.raises(ConfigError, match="holds no run; leave --resume out to start one"):
                train.prepare(run, folder, True, False, source)
            train.prepare(run, folder, False, False, source)
        else:
            with train.prepare(run, folder, resume, overwrite, source):
                pass
        check(folder, run, source)


def test_after_a_kill_in_the_beginning_of_a_replacement_the_old_run_is_restored(parent, tmp_path):
    folder_of_all, count, run, _ = left_by_kills(parent, tmp_path, "overwrite", True)
    assert count > 15
    for operation in range(count):
        folder = folder_of_all / str(operation) / "run"
        try:
            train.prepare(run, folder, True, False)
        except ConfigError as error:
            assert "to restore the old run, or" in str(error), operation
            run_folder.remove(folder)  # the remedy
            train.prepare(run, folder, True, False)
        now = {name: content for name, content in files(folder).items() if name not in (".lock", ".replacement")}
        assert now.keys() == {"run.toml", "env.json", "metrics.jsonl"}, operation
        assert now["metrics.jsonl"] == b"of the old run\n"
        assert not run_folder.aside_of(folder).exists()


def test_a_beginning_with_a_file_of_the_user_is_refused_by_name(module_run, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / ".beginning").touch()
    (folder / "notes.md").write_text("mine")
    for resume, overwrite in OPTIONS.values():
        with pytest.raises(ConfigError, match=r"holds notes\.md, not written by icrl-dist"):
            train.prepare(module_run, folder, resume, overwrite)
    assert files(folder) == {".beginning": b"", "notes.md": b"mine"}


def test_a_beginning_that_is_active_is_not_removed(module_run, tmp_path):
    with run_folder.beginning(tmp_path / "run"):
        (tmp_path / "run" / "run.toml").write_text("half")
        with pytest.raises(ConfigError, match="another command begins a run in this folder"):
            train.prepare(module_run, tmp_path / "run", False, False)
    assert files(tmp_path) == {"run/run.toml": b"half"}


def test_parts_of_interrupted_writes_are_swept_and_those_of_active_processes_stay(module_run, tmp_path):
    folder = tmp_path / "run"
    train.prepare(module_run, folder, False, False)
    for name in ("checkpoints", "dataset"):
        (folder / name).mkdir()
    dead, active = 2**22 + 1, os.getpid()
    swept = [
        f".run.toml.{dead}.part",
        f"checkpoints/.version-0000.npz.{dead}.part",
        f"dataset/.segment-000000.frames.{dead}.part",
    ]
    kept = [f"checkpoints/.partial.npz.{active}.part", f".notes.md.{dead}.part"]
    for name in (*swept, *kept):
        (folder / name).touch()
    train.prepare(module_run, folder, True, False)
    assert [name for name in (*swept, *kept) if (folder / name).exists()] == kept
