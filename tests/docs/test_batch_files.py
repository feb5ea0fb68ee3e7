"""The files for Slurm, systemd and Kubernetes in ``deploy/batch``: run as far as they can be without these systems."""

import configparser
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from icrl_dist.cli import main
from icrl_dist.config.run import dumps
from icrl_dist.launch import learner_process
from icrl_dist.launch import train as launch

pytestmark = pytest.mark.integration

BATCH = Path("deploy/batch").absolute()
DOCS = Path("docs/clusters.md").absolute()
SLURM, SYSTEMD, KUBERNETES = BATCH / "slurm.sh", BATCH / "icrl-dist.service", BATCH / "kubernetes.yaml"


def test_the_page_about_clusters_links_to_each_file():
    linked = set(re.findall(r"\]\(\.\./(deploy/batch/[\w.-]+)\)", DOCS.read_text()))
    assert linked == {f"deploy/batch/{path.name}" for path in BATCH.iterdir()}


@pytest.fixture
def slurm(tmp_path, module_run):
    """Start the script as Slurm does, with programs that run this code and record the calls of ``scontrol``."""
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "icrl-dist").write_text(f'#!/bin/bash\nexec {sys.executable} -m icrl_dist.cli "$@" --engine inline\n')
    (programs / "scontrol").write_text(f'#!/bin/bash\necho "$@" >> {tmp_path}/scontrol\n')
    for program in programs.iterdir():
        program.chmod(0o755)
    (tmp_path / "small.toml").write_text(dumps(module_run))
    environment = {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": str(Path.cwd()),
        "SLURM_SUBMIT_DIR": str(tmp_path),
        "SLURM_JOB_ID": "42",
        "SLURM_CPUS_PER_TASK": "1",
        "HOME": str(tmp_path),
    }
    started = []

    def start(*words):
        log = (tmp_path / "log").open("ab")
        command = ["bash", str(SLURM), "small.toml", "--pretrain.steps", "1500", *words]
        started.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True))
        log.close()
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_the_slurm_script_is_warned_queued_again_continues_and_ends_at_once_when_finished(slurm, tmp_path):
    options = re.findall(r"(?m)^#SBATCH (--\S+)$", SLURM.read_text())
    assert {"--signal=B:USR1@120", "--requeue", "--open-mode=append"} <= set(options)
    metrics, log, deadline = tmp_path / "runs" / "small" / "metrics.jsonl", tmp_path / "log", time.monotonic() + 120
    process = slurm()
    while not metrics.exists() or '"fit/0"' not in metrics.read_text():
        assert time.monotonic() < deadline and process.poll() is None, log.read_text()
        time.sleep(0.05)
    process.send_signal(signal.SIGUSR1)
    assert process.wait(60) == 130, log.read_text()
    assert (tmp_path / "scontrol").read_text() == "requeue 42\n"
    assert (metrics.parent / "checkpoints" / "partial.npz").exists()
    assert "interrupted; `icrl-dist train small.toml " in log.read_text().splitlines()[-1]
    assert slurm().wait(120) == 0, log.read_text()
    result = (metrics.parent / "result.json").read_text()
    rows = [json.loads(line) for line in metrics.read_text().splitlines()]
    assert len({row["step"] for row in rows if row["stage"] == "fit/0"}) == 30
    assert slurm().wait(60) == 0
    assert "the run is finished" in log.read_text() and (metrics.parent / "result.json").read_text() == result
    assert slurm("--no-such-option").wait(60) == 2
    assert (tmp_path / "scontrol").read_text() == "requeue 42\n", "only a warned run is queued again"


@pytest.fixture
def called(tmp_path, monkeypatch):
    """Call the command line with these words of a file, up to the training, which is interrupted; returns the exit code."""

    def interrupted(run, folder, *_):
        (folder / "checkpoints").mkdir(exist_ok=True)
        (folder / "checkpoints" / "partial.npz").touch()
        raise launch.TrainInterrupted

    monkeypatch.setattr(launch, "train_ray", interrupted)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))
    monkeypatch.chdir(tmp_path)

    def call(words):
        assert Path(words[0]).name == "icrl-dist"
        return main.main([re.sub(r"^(/srv/icrl)?/runs/", f"{tmp_path}/runs/", word) for word in words[1:]])

    return call


def test_the_unit_of_systemd(called, tmp_path, capsys):
    unit = configparser.ConfigParser()
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(SYSTEMD.read_text())
    service = unit["Service"]
    for _ in range(2):
        assert called(service["ExecStart"].split()) == int(service["SuccessExitStatus"]) == 130
    assert "train demo --resume-or-begin" in capsys.readouterr().out.splitlines()[-1]
    assert (service["KillMode"], service["Restart"]) == ("mixed", "on-failure")
    assert int(service["TimeoutStopSec"]) >= learner_process.CHECKPOINT_S + 30
    assert called([*service["ExecStart"].split(), "--seed", "1"]) == int(service["RestartPreventExitStatus"]) == 2
    if shutil.which("systemd-analyze"):
        there = tmp_path / SYSTEMD.name
        text = re.sub(r"(?m)^ExecStart=\S+", "ExecStart=/bin/true", SYSTEMD.read_text())
        there.write_text(text.replace("User=icrl\n", "User=root\n").replace("/srv/icrl", "/tmp"))
        found = subprocess.run(["systemd-analyze", "verify", there], capture_output=True, text=True, timeout=60)
        assert (found.returncode, found.stdout + found.stderr) == (0, "")


def test_the_job_of_kubernetes(called):
    volume, job = yaml.safe_load_all(KUBERNETES.read_text())
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert (job["kind"], volume["kind"]) == ("Job", "PersistentVolumeClaim")
    for _ in range(2):
        assert called(container["command"]) == 130
    claims = {one["name"]: one.get("persistentVolumeClaim", {}).get("claimName") for one in pod["volumes"]}
    mounted = {one["mountPath"]: claims[one["name"]] for one in container["volumeMounts"]}
    out = container["command"][container["command"].index("--out") + 1]
    assert mounted[str(Path(out).parent)] == volume["metadata"]["name"], "the run folder outlives the pod"
    assert pod["restartPolicy"] == "Never" and pod["terminationGracePeriodSeconds"] >= learner_process.CHECKPOINT_S + 30
    (fail,) = [rule for rule in spec["podFailurePolicy"]["rules"] if rule["action"] == "FailJob"]
    assert fail["onExitCodes"]["values"] == [2] and called([*container["command"], "--seed", "1"]) == 2
