"""Commands on a run folder that cannot be written, as a mounted archive or another user's folder."""

import json
import subprocess

import pytest

from icrl_dist.launch import whole_run
from icrl_dist.telemetry import processes

pytestmark = pytest.mark.integration

SCRIPT = """
import contextlib, io, json, sys
from icrl_dist.cli.main import main
from icrl_dist.monitor.recording import Recording
from pathlib import Path
folder, elsewhere = map(Path, sys.argv[1:])
def run(*words):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main([*map(str, words)])
    return code, out.getvalue(), err.getvalue()
answers = {
    "evaluate": run("evaluate", folder, "--episodes", 2, "--seeds", 1, "--p", 0, "--json"),
    "ledger": run("explain", folder),
    "explain": run("explain", folder, "adapt/0/0/0/0", "--rerun"),
    "export elsewhere": run("export", folder, "--out", elsewhere / "agent.npz"),
    "export": run("export", folder),
    "resume": run("train", folder / "run.toml", "--resume", "--out", folder),
    "fork": run("train", "--from", f"{folder}@0", "--set", "icaa.trials=3", "--engine", "inline", "--out", elsewhere / "fork"),
}
print(json.dumps({**answers, "replayed": sum(1 for _ in Recording(folder).messages())}))
"""


@pytest.fixture(scope="module")
def made(module_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive") / "run"
    whole_run.train(module_run, folder, engine="inline")
    return folder


@pytest.fixture(scope="module")
def answers(made, tmp_path_factory):
    """Exit code and output of commands in a mount namespace in which the run folder is read-only."""
    mount = 'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && exec "$@"'
    command = processes.python("-c", SCRIPT, str(made), str(tmp_path_factory.mktemp("elsewhere")))
    namespace = ["unshare", "-rm", "sh", "-c", mount, str(made)]
    if subprocess.run([*namespace, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this machine allows no mount namespaces")
    done = subprocess.run([*namespace, *command], env=processes.environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("command", ["evaluate", "ledger", "explain", "export elsewhere", "fork"])
def test_they_work_and_write_elsewhere(answers, command):
    code, output, errors = answers[command]
    assert code == 0, errors
    if command == "evaluate":
        assert json.loads(output.splitlines()[-1])["rows"]
        (line,) = [line for line in errors.splitlines() if line.startswith("not stored: ")]
        assert "Read-only file system" in line
    if command == "ledger":
        assert json.loads(output.splitlines()[0])["identity"]
    if command == "explain":
        assert "the same bytes" in output


def test_a_read_only_run_is_replayed(answers):
    assert answers["replayed"] > 0


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        ("export", 1, "agent.npz: could not be written (Read-only file system)"),
        ("resume", 2, "cannot be written (Read-only file system)"),
    ],
)
def test_what_must_write_there_says_so_in_one_line(answers, command, code, message):
    found, _, errors = answers[command]
    assert found == code and message in errors.splitlines()[-1] and "Traceback" not in errors
