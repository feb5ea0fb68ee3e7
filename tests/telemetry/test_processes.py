"""Python processes of this package import no file of the user from the current folder, and run their parent's code."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import icrl_dist
from icrl_dist.telemetry import processes

ROOT = Path(icrl_dist.__file__).parents[1]
PRINT = "import learner, actors, queue, random; print(*(m.__file__ for m in (learner, actors, queue, random)), sep='\\n')"


@pytest.fixture
def hostile(tmp_path):
    for name in ("actors", "learner", "queue", "random"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('the {name}.py of the user was imported')")
    return tmp_path


@pytest.mark.integration
@pytest.mark.parametrize("python_path", ["", os.pathsep, "elsewhere" + os.pathsep])
def test_files_of_the_user_in_the_current_folder_are_not_imported(hostile, monkeypatch, python_path):
    monkeypatch.setenv("PYTHONPATH", python_path)
    environment = processes.environment()
    done = subprocess.run(
        processes.python("-c", PRINT), cwd=hostile, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    learner, actors, *standard = map(Path, done.stdout.splitlines())
    assert learner.parents[1] == actors.parents[1] == ROOT
    assert not any(hostile in file.parents for file in standard)


@pytest.mark.integration
def test_the_command_started_as_a_module_does_not_import_them_either(hostile, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    command = [sys.executable, "-m", "icrl_dist.cli", "--version"]
    done = subprocess.run(command, cwd=hostile, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, icrl_dist.__version__), done.stderr


def test_the_search_path_names_a_checkout_and_no_installed_package(monkeypatch):
    monkeypatch.setattr(processes, "__file__", "/checkout/icrl_dist/telemetry/processes.py")
    assert processes.code_path() == ["/checkout"]
    monkeypatch.setenv("PYTHONPATH", f"{os.pathsep}/plugins{os.pathsep}")
    assert processes.environment()["PYTHONPATH"] == f"/checkout{os.pathsep}/plugins"
    site = next(place for place in sys.path if place.endswith("site-packages"))
    monkeypatch.setattr(processes, "__file__", f"{site}/icrl_dist/telemetry/processes.py")
    assert processes.code_path() == []
