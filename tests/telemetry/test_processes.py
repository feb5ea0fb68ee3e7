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


POLICY = """
import os, sys
{first}
import icrl_dist
{use}
print("torch" in sys.modules, os.environ.get("OMP_WAIT_POLICY"))
"""


LOADED = "icrl_dist.load_agent('darkroom', decoder='torch')"


@pytest.mark.integration
@pytest.mark.parametrize("use", ["icrl_dist.evaluate", LOADED, "icrl_dist.train"])
def test_idle_threads_of_torch_sleep_also_in_a_process_of_python(use):
    """libgomp prints for how long its idle threads spin; a process that has set a policy keeps it."""
    environment = {**processes.environment(), "OMP_DISPLAY_ENV": "verbose"}
    del environment["OMP_WAIT_POLICY"]
    if use == "icrl_dist.train":
        use = "import icrl_dist.launch.whole_run as w; icrl_dist.train; assert 'torch' not in sys.modules; w.import_torch()"
    for first, spins, kept in (("", "0", "None"), ("os.environ['OMP_WAIT_POLICY'] = 'ACTIVE'", "30000000000", "ACTIVE")):
        script = POLICY.format(first=first, use=use) + "import torch; torch.ones(1)"
        done = subprocess.run(processes.python("-c", script), env=environment, capture_output=True, text=True, check=False)
        assert f"GOMP_SPINCOUNT = '{spins}'" in done.stderr, done.stderr
        assert done.stdout.split()[1] == kept, done.stderr
