"""A problem and a method of another package, through Ray and Zenoh: no other file of the system changes for them."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.training import CLI, NO_RESTARTS, endpoint_of, equal, finish, on_first_adapt_trajectory, result_of, start

ROOT = Path(__file__).parents[2]
RUN = """
problem = "toy-corridor"
method = "return-to-go"
[corridor]
cells = 5
[return_to_go]
target = 4.0
[adversary]
count = 2
[pretrain]
contexts = 32
steps = 20
[model]
width = 8
layers = 1
[optim]
batch = 8
[evaluate]
episodes = 3
seeds = 2
[learner]
threads = 1
[stream]
job_tasks = 2
"""
ENTRY_POINTS = """
[icrl_dist.problems]
toy-corridor = tests.toys.corridor:CorridorProblem
[icrl_dist.methods]
return-to-go = tests.toys.return_to_go:ReturnToGo
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """An environment in which a package with both is installed, and their run file."""
    site = tmp_path_factory.mktemp("site")
    package = site / "toys-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: toys\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(ENTRY_POINTS)
    (site / "toy.toml").write_text(RUN)
    paths = [str(site), str(ROOT), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}, site / "toy.toml"


@pytest.fixture(scope="module")
def trained(installed, tmp_path_factory):
    """A whole run through Ray and Zenoh, with a tap beside it."""
    environment, run = installed
    folder = tmp_path_factory.mktemp("runs") / "toy"
    process = start("train", run, *NO_RESTARTS, "--out", folder, "--json", env=environment)
    tap = [*CLI, "tap", "--connect", endpoint_of(folder), "--count", "3", "--timeout", "60"]
    tapped = subprocess.run(tap, env=environment, capture_output=True, text=True, timeout=200)
    output = finish(process)
    assert process.returncode == 0, output
    return folder, output, tapped


def test_they_train_through_ray_and_are_evaluated(trained):
    folder, _, _ = trained
    result = result_of(folder)
    assert (result["version"], result["trajectories"]) == (1, 32 + 4 * 2 * 3)
    agents = {row["agent"] for row in result["rows"]}
    assert agents == {"T^1 (return-to-go)", "T^0", "random"}
    assert all(len(row["episodes"]) == 3 and row["optimum"] is None for row in result["rows"])


def test_they_are_watched(trained):
    _, _, tapped = trained
    rows = [json.loads(line) for line in tapped.stdout.splitlines()]
    assert len(rows) == 3 and {row["problem"] for row in rows} == {"toy-corridor"}, tapped.stderr
    assert {row["adversary"]["kind"] for row in rows} <= {"null", "slip"}


def test_one_process_makes_the_same_bytes(installed, trained, tmp_path):
    environment, run = installed
    again = start("train", run, "--engine", "inline", "--out", tmp_path / "inline", env=environment)
    output = finish(again)
    assert again.returncode == 0, output
    assert equal(result_of(tmp_path / "inline"), result_of(trained[0]))


def test_an_interrupted_run_is_resumed_to_the_same_bytes(installed, trained, tmp_path):
    environment, run = installed
    folder = tmp_path / "toy"
    process = start("train", run, *NO_RESTARTS, "--out", folder, env=environment)
    with on_first_adapt_trajectory(folder, lambda: process.send_signal(signal.SIGINT)) as acted:
        output = finish(process)
    assert acted.is_set() and process.returncode == 130, output
    again = start("train", run, *NO_RESTARTS, "--out", folder, "--resume", env=environment)
    output = finish(again)
    assert again.returncode == 0, output
    assert equal(result_of(folder), result_of(trained[0]))


def test_their_agent_is_deployed_from_python(installed, trained):
    script = """
import sys, numpy as np, icrl_dist
agent = icrl_dist.load_agent(sys.argv[1], seed=0)
task = icrl_dist.Task.of("toy-corridor", **agent.manifest["test_tasks"][0])
env = icrl_dist.make(icrl_dist.Variation(task))
for episode in range(2):
    obs, over, total = env.reset(seed=episode)[0], False, 0.0
    while not over:
        action = agent.act([obs])
        following, reward, _, over, _ = env.step(action[0])
        agent.observe([obs], action, [reward], [following], [over])
        obs, total = following, total + reward
print(agent.manifest["problem"], total)
"""
    environment, _ = installed
    ran = subprocess.run([sys.executable, "-c", script, trained[0]], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0 and ran.stdout.startswith("toy-corridor "), ran.stderr


def test_a_trajectory_of_theirs_is_explained_and_repeated(installed, trained):
    environment, _ = installed
    command = [*CLI, "explain", str(trained[0]), "adapt/0/1/1/2", "--rerun", "--json"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert json.loads(ran.stdout.splitlines()[-1])["rerun_equal"]


def test_a_run_file_of_theirs_is_refused_where_they_are_not_installed(installed, capsys):
    from icrl_dist.cli.main import main

    assert main(["train", str(installed[1])]) == 2
    assert "problem = 'toy-corridor'" in capsys.readouterr().err
