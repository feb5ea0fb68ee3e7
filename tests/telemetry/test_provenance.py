"""A run, its checkpoints, its agent and its result rows say what made them; a session with other software is reported."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from icrl_dist import __version__, load_agent, read_results, version
from icrl_dist.cli import main
from icrl_dist.config import plugins
from icrl_dist.launch import train
from icrl_dist.results import rows
from icrl_dist.storage.checkpoint import load_checkpoint, version_file
from icrl_dist.telemetry import provenance
from icrl_dist.telemetry.metrics import Metrics
from learner import service
from tests.results.row_blocks import block

DECIDES_BYTES = {"python", "torch", "numpy", "mujoco", "dm-control", "metaworld", "stable-baselines3", "ray", "eclipse-zenoh"}
WORDS = ("--episodes", "1", "--seeds", "1", "--p", "0")
METRICS = Metrics


def git(folder: Path, *words: str) -> str:
    settings = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    return subprocess.run(
        ["git", "-C", str(folder), *settings, *words], capture_output=True, text=True, check=True
    ).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A Git checkout with the three packages, in one commit."""
    root = tmp_path / "checkout"
    for package in version.PACKAGES:
        (root / package).mkdir(parents=True)
        (root / package / "code.py").write_text("x = 1\n")
    (root / "notes.md").write_text("x")
    git(tmp_path, "init", "--quiet", str(root))
    git(root, "add", ".")
    git(root, "commit", "--quiet", "-m", "first")
    return root


def commit(root: Path) -> str:
    return provenance.commit.__wrapped__(root)  # without the cache


def test_the_commit_of_a_checkout_says_whether_the_code_was_changed(checkout: Path, tmp_path: Path) -> None:
    found = git(checkout, "rev-parse", "HEAD")
    assert len(found) == 40 and commit(checkout) == found
    (checkout / "notes.md").write_text("not code")
    assert commit(checkout) == found
    (checkout / "learner" / "code.py").write_text("x = 2\n")
    assert commit(checkout) == f"{found}-dirty"
    git(checkout, "add", ".")
    assert commit(checkout) == f"{found}-dirty"
    git(checkout, "worktree", "add", "--quiet", str(tmp_path / "other"))
    assert commit(tmp_path / "other") == found
    (tmp_path / "other" / "actors" / "new.py").touch()
    assert commit(tmp_path / "other") == f"{found}-dirty"


def test_code_outside_a_checkout_has_no_commit(checkout: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    installed = checkout / "venv" / "site-packages"  # the checkout around it is another project's
    installed.mkdir(parents=True)
    assert commit(installed) == "" and commit(tmp_path / "none") == ""
    git(tmp_path, "init", "--quiet", str(tmp_path / "empty"))
    assert commit(tmp_path / "empty") == ""
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "empty" / ".git"))  # as in a hook of another repository
    assert len(commit(checkout)) == 40
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit(checkout) == ""
    (checkout / ".git" / "HEAD").unlink()
    monkeypatch.undo()
    assert commit(checkout) == ""


def test_a_processor_without_a_name_has_its_architecture(tmp_path: Path) -> None:
    (tmp_path / "named").write_text("vendor_id\t: x\nmodel name\t: AMD EPYC 9B14\nmodel name\t: other\n")
    (tmp_path / "arm").write_text("CPU part\t: 0xd0c\n")
    found = [provenance.processor.__wrapped__(tmp_path / name) for name in ("named", "arm", "none")]
    assert found == ["AMD EPYC 9B14", platform.machine(), platform.machine()]


def test_the_package_of_the_problem_and_the_method_is_recorded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = plugins.Source("rooms", "3.1", "c" * 64)
    monkeypatch.setattr(plugins, "sources", lambda: {"problems/darkroom": source, "methods/other": source})
    found = provenance.record("darkroom", "dpt", 1)
    assert found["plugins"] == {"problems/darkroom": {"distribution": "rooms", "version": "3.1", "code": "c" * 64}}
    rows.append(tmp_path / "results", "online", {}, [block([[[1.0]]])])
    (row,) = read_results(tmp_path).to_dict("records")
    assert json.loads(row["libraries"]) == {**found["libraries"], **found["plugins"]}
    newer = {**found, "plugins": {"problems/darkroom": source._replace(version="3.2")._asdict()}}
    expected = "problems/darkroom rooms 3.1 with code cccccccc (now rooms 3.2 with code cccccccc)"
    assert provenance.differences(found, newer) == expected


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, module_run: Any) -> tuple[Path, dict[str, Any]]:
    """The folder of a finished run, and its result."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "Metrics", lambda folder, **options: METRICS(folder, tensorboard=False, **options))
        train.prepare(module_run, folder, resume=False, overwrite=False)
        assert provenance.sessions(folder) == []
        return folder, train.train_inline(module_run, folder, lambda event: None)


def test_run_checkpoint_agent_and_rows_say_what_made_them(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, result = finished
    (session,) = provenance.sessions(folder)
    assert session["began"].startswith("20") and session["policy_version"] == -1 and session["cores"] >= 1
    assert session["package_version"] == __version__ and session["code_digest"] == version.digest()
    assert session["libraries"].keys() >= DECIDES_BYTES and session["libraries"]["torch"] == metadata.version("torch")
    assert session["threads"] == result["threads"] == 1 and session["device"] == "cpu"
    assert session["instruction_set"] == result["instruction_set"] and session["processor"]
    assert session["any_machine"] == result["any_machine"]
    assert session["commit"].removesuffix("-dirty") == git(Path(__file__).parent, "rev-parse", "HEAD")
    made_by = load_checkpoint(version_file(folder, 1)).manifest["made_by"]
    assert made_by.items() <= session.items() and made_by.keys() == provenance.record("darkroom", "icaa", 1).keys()
    assert main.main(["export", str(folder), "--out", str(tmp_path / "agent.npz")]) == 0
    assert load_agent(tmp_path / "agent.npz").manifest["made_by"] == made_by
    assert main.main(["evaluate", str(folder), *WORDS]) == 0
    row = read_results(folder, unfinished=True).iloc[-1]
    for name in ("package_version", "code_digest", "commit", "instruction_set", "threads"):
        assert row[name] == made_by[name]
    assert json.loads(row["libraries"]) == made_by["libraries"]
    capsys.readouterr()
    assert main.main(["explain", str(folder), "adapt/0/0/0/0"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("run by")]
    assert f"icrl-dist {__version__}, code {version.digest()[:8]}" in line and "continued" not in line


def test_a_resume_with_other_software_is_noted_and_recorded_and_changes_no_digest(
    finished: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], module_run: Any
) -> None:
    folder, before = finished
    began = provenance.sessions(folder)
    present, installed = provenance.record("darkroom", "icaa", 1), metadata.version
    events: list[dict[str, Any]] = []

    def resume() -> dict[str, Any]:
        events.clear()
        train.prepare(module_run, folder, resume=True, overwrite=False)
        return train.train_inline(module_run, folder, events.append)

    resume()
    assert [event for event in events if event["event"] == "note"] == []
    provenance._libraries.cache_clear()
    monkeypatch.setattr(metadata, "version", lambda name: "1.0" if name == "torch" else installed(name))
    monkeypatch.setattr(version, "digest", lambda: "e" * 64)
    for number in (1, 2):  # these are fitted again, with another manifest
        version_file(folder, number).unlink()
    result = resume()
    monkeypatch.undo()
    provenance._libraries.cache_clear()
    (note,) = [event["text"] for event in events if event["event"] == "note"]
    code, torch = present["code_digest"][:8], present["libraries"]["torch"]
    changed = f"code {code} (now eeeeeeee), torch {torch} (now 1.0)"
    assert note == f"this run began with {changed}: digests can differ from those of an uninterrupted run"
    sessions = provenance.sessions(folder)
    assert sessions[: len(began)] == began and len(sessions) == len(began) + 2
    assert [one["libraries"]["torch"] for one in sessions[-2:]] == [torch, "1.0"] and sessions[-1]["policy_version"] == 0
    assert load_checkpoint(version_file(folder, 1)).manifest["made_by"]["libraries"]["torch"] == "1.0"
    for name in ("dataset_digest", "weights_digest"):
        assert result[name] == before[name]
    assert main.main(["explain", str(folder), "adapt/0/0/0/0"]) == 0
    assert f"; continued with other software or hardware: {changed}\n" in capsys.readouterr().out


def test_a_trajectory_of_the_parent_was_not_made_by_the_fork(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str], module_run: Any
) -> None:
    fork = tmp_path / "fork"
    train.prepare(module_run, fork, resume=False, overwrite=False, source=(finished[0], 0))
    provenance.add_session(fork, 0, provenance.record("darkroom", "icaa", 1))
    for folder, shown in ((finished[0], True), (fork, False)):
        assert main.main(["explain", str(folder), "pretrain/0/0/0/0"]) == 0
        assert ("\nrun by " in capsys.readouterr().out) == shown


def test_the_file_of_0_1_0_is_the_first_session(tmp_path: Path) -> None:
    old = {
        "python": "3.11.2",
        "platform": "Linux",
        "cores": 2,
        "versions": {"icrl-dist": "0.1.0", "torch": "2.8.0", "gone": "1"},
    }
    (tmp_path / "env.json").write_text(json.dumps(old))
    provenance.create(tmp_path)  # a run that continues keeps it
    now = provenance.record("darkroom", "dpt", 2)
    libraries = now["libraries"]
    assert provenance.add_session(tmp_path, 3, now) == (
        f"this run began with icrl-dist 0.1.0 (now {__version__}), python 3.11.2 (now {libraries['python']}), "
        f"torch 2.8.0 (now {libraries['torch']}): digests can differ from those of an uninterrupted run"
    )
    first, second = provenance.sessions(tmp_path)
    assert first["libraries"] == {"python": "3.11.2", "torch": "2.8.0", "gone": "1"} and first["cores"] == 2
    assert second["policy_version"] == 3 and now.items() <= second.items()
    assert provenance.text(first) == "icrl-dist 0.1.0, python 3.11.2, torch 2.8.0, numpy unknown"
    assert provenance.text({**first, "threads": 2, "any_machine": True}).endswith(", threads 2, the same bytes on any machine")


@pytest.mark.parametrize("content", [None, "", "[]", "{", "null", '{"sessions": 3}', '{"sessions": [3]}', '{"versions": 3}'])
def test_a_missing_or_damaged_file_is_begun_again(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "env.json").write_text(content)
    assert provenance.sessions(tmp_path) == []
    damaged = f"{tmp_path / 'env.json'}: was damaged, so its earlier sessions are lost; it is written anew"
    assert provenance.add_session(tmp_path, -1, {"threads": 2}) == ("" if content is None else damaged)
    (session,) = provenance.sessions(tmp_path)
    assert session["threads"] == 2 and session["cores"] == len(os.sched_getaffinity(0))
