"""A problem and a method of another package, through Ray and Zenoh: no other file of the system changes for them."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from icrl_dist.storage.checkpoint import version_file
from learner import checkpoints
from tests.e2e.training import (
    CLI,
    NO_RESTARTS,
    descendants_of,
    endpoint_of,
    equal,
    finish,
    on_first_adapt_trajectory,
    result_of,
    start,
)

ROOT = Path(__file__).parents[2]
RUN = """
problem = "toy-corridor"
method = "return-to-go"
[corridor]
cells = 5
[return_to_go]
target = 4.0
[adversary]
count = 1
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
    hostile = site / "hostile"
    hostile.mkdir()
    for name in ("actors", "learner", "queue", "random"):  # files of the user in the folder where the commands are started
        (hostile / f"{name}.py").write_text("raise SystemExit('a file of the user was imported')")
    paths = [str(site), str(ROOT), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}, site / "toy.toml"


@pytest.fixture(scope="module")
def interrupted(installed, tmp_path_factory):
    """A run through Ray and Zenoh with a tap beside it, stopped by Ctrl-C in the first round."""
    environment, run = installed
    folder = tmp_path_factory.mktemp("runs") / "toy"
    among = run.parent / "hostile"
    process = start("train", run, *NO_RESTARTS, "--out", folder, env=environment, start_new_session=True, cwd=among)
    tap = [*CLI, "tap", "--connect", endpoint_of(folder), "--count", "3", "--timeout", "60"]
    family = []

    def interrupt():
        family.extend(descendants_of(process))
        os.killpg(process.pid, signal.SIGINT)

    with subprocess.Popen(tap, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tapping:
        with on_first_adapt_trajectory(folder, interrupt) as acted:
            output = finish(process)
        tapped = tapping.communicate(timeout=200)
    assert acted.is_set() and process.returncode == 130, output
    return folder, output, tapped, family


@pytest.fixture(scope="module")
def trained(installed, interrupted):
    """The folder of the same run, resumed through Ray and Zenoh, and the weights digest of its first version before."""
    environment, run = installed
    folder = interrupted[0]
    before = checkpoints.read_manifest(version_file(folder, 0))["weights_digest"]
    process = start("train", run, *NO_RESTARTS, "--out", folder, "--resume", env=environment, cwd=run.parent / "hostile")
    output = finish(process)
    assert process.returncode == 0, output
    return folder, before


def test_they_are_watched(interrupted):
    _, _, (printed, errors), _ = interrupted
    rows = [json.loads(line) for line in printed.splitlines()]
    assert len(rows) == 3 and {row["problem"] for row in rows} == {"toy-corridor"}, errors
    assert {row["adversary"]["kind"] for row in rows} <= {"null", "slip"}


def test_ctrl_c_leaves_a_checkpoint_and_no_process(interrupted):
    folder, output, _, family = interrupted
    assert "--resume" in output and version_file(folder, 0).exists()
    _, alive = psutil.wait_procs(family, timeout=60)
    assert family and not [p.cmdline() for p in alive]


def test_they_train_through_ray_and_are_evaluated(trained):
    result = result_of(trained[0])
    assert (result["version"], result["trajectories"]) == (1, 32 + 4 * 2 * 3)
    agents = {row["agent"] for row in result["rows"]}
    assert agents == {"T^1 (return-to-go)", "T^0", "random"}
    assert all(len(row["episodes"]) == 3 and row["optimum"] is None for row in result["rows"])


@pytest.fixture(scope="module")
def inline(installed, tmp_path_factory):
    """The folder of the same run in one process."""
    environment, run = installed
    folder = tmp_path_factory.mktemp("runs") / "inline"
    process = start("train", run, "--engine", "inline", "--out", folder, env=environment)
    output = finish(process)
    assert process.returncode == 0, output
    return folder


def test_one_process_makes_the_same_bytes_as_ray(trained, inline):
    assert trained[1] == checkpoints.read_manifest(version_file(inline, 0))["weights_digest"]


def test_an_interrupted_run_is_resumed_to_the_same_bytes(trained, inline):
    assert equal(result_of(trained[0]), result_of(inline))


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
