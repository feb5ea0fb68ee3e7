"""A file of the user with the name of a module that a run needs is named before the run."""

import subprocess
import sys

import pytest

import icrl_dist
from icrl_dist import ConfigError
from icrl_dist.diagnostics import modules
from icrl_dist.launch import train
from icrl_dist.telemetry import processes


@pytest.mark.parametrize("name", ["random.py", "learner.py", "numpy/__init__.py", "zenoh.py"])
def test_a_file_in_the_search_path_fails_and_one_in_the_current_folder_is_a_warning(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert modules.check_modules().ok is True
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("")
    (tmp_path / "unrelated.py").write_text("")
    check = modules.check_modules()
    assert check.ok is None and name in check.value and "-P" in check.remedy
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    check = modules.check_modules()
    assert check.ok is False and str(tmp_path / name) in check.value and "rename" in check.remedy


def test_a_folder_without_init_hides_nothing(tmp_path, monkeypatch):
    (tmp_path / "random").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert modules.check_modules().ok is True


def test_one_process_refuses_a_file_that_hides_the_learner(small_run, tmp_path, monkeypatch):
    (tmp_path / "learner.py").write_text("")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    with pytest.raises(ConfigError, match=rf"{tmp_path}/learner.py hides the package 'learner'.*rename"):
        train.train_inline(small_run, tmp_path / "run", lambda event: None)


@pytest.mark.integration
def test_a_script_beside_such_a_file_is_told_its_name(tmp_path):
    (tmp_path / "actors.py").write_text("")
    (tmp_path / "script.py").write_text("import icrl_dist\nicrl_dist.train")
    command = [sys.executable, str(tmp_path / "script.py")]
    done = subprocess.run(command, env=processes.environment(), capture_output=True, text=True, check=False)
    assert f"ImportError: {tmp_path}/actors.py hides the package 'actors'" in done.stderr, icrl_dist.__file__
