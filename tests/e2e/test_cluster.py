"""The cluster file that is shipped: what Ray says of it, and a run on the hosts that it brings up."""

import contextlib
import copy
import json
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

import click
import jsonschema
import psutil
import pytest
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from tests.e2e import hosts

FILE = hosts.ROOT / "deploy" / "clusters" / "onprem.yaml"
# Small enough to leave most of the time to the cluster itself.
SMALL = "--pretrain.contexts 28 --pretrain.steps 4 --icaa.steps 4 --evaluate.episodes 1 --evaluate.seeds 1"
TRAIN = ["train", "smoke", *SMALL.split()]


def shipped():
    return yaml.safe_load(FILE.read_text())


def accepted(config):
    """The configuration as Ray fills it in; raises what Ray raises for one that it refuses."""
    whole = prepare_config(copy.deepcopy(config))
    validate_config(whole)
    return whole


def test_ray_accepts_the_shipped_file_and_wants_every_worker():
    whole = accepted(shipped())
    (kind,) = whole["available_node_types"].values()
    assert kind["min_workers"] == kind["max_workers"] == len(shipped()["provider"]["worker_ips"])


@pytest.mark.parametrize(
    ("where", "key", "value"),
    [
        ((), "setup_comands", []),
        ((), "worker_start_ray_commands", "ray start"),
        ((), "idle_timeout_minutes", "five"),
        (("auth",), "ssh_usr", "ubuntu"),
        (("auth",), "ssh_private_key", 7),
    ],
)
def test_ray_refuses_a_file_with_a_slip(where, key, value):
    config = shipped()
    table = config
    for name in where:
        table = table[name]
    table[key] = value
    with pytest.raises(jsonschema.ValidationError, match=key if key not in shipped() else str(value)):
        accepted(config)


def test_ray_refuses_a_file_without_workers():
    config = shipped()
    del config["provider"]["worker_ips"]
    with pytest.raises(click.ClickException):
        accepted(config)


def test_what_the_package_is_made_of_is_sent_to_the_hosts():
    project = tomllib.loads((hosts.ROOT / "pyproject.toml").read_text())
    sources = {source for source in shipped()["file_mounts"].values() if not source.startswith("~")}
    assert sources == {"pyproject.toml", "constraints.txt", project["project"]["readme"]} | {
        package.split(".")[0] for package in project["tool"]["setuptools"]["packages"]
    }
    assert all((hosts.ROOT / source).exists() for source in sources)


def filled_in(head, workers):
    """The shipped file for these hosts, which have the tests' environment already, and a core each to give."""
    config = shipped()
    config["provider"] |= {"head_ip": head.address, "worker_ips": [worker.address for worker in workers]}
    config["auth"] |= {"ssh_user": "root", "ssh_private_key": "~/.ssh/id_ed25519"}
    _make, _install, path = config["setup_commands"]
    config["setup_commands"] = [f"ln -sfn {sys.prefix} ~/icrl-dist/.venv", path]
    config["worker_start_ray_commands"][-1] += " --num-cpus=1"
    return yaml.safe_dump(config)


@dataclass(frozen=True)
class Cluster:
    """Machines that `ray up` was run for, and the one it was run on."""

    desk: hosts.Host
    head: hosts.Host
    workers: tuple[hosts.Host, ...]

    FILE = f"{hosts.HOME}/onprem.yaml"
    CERTIFICATES = f"{hosts.HOME}/.icrl/certificates"

    @staticmethod
    def ray(*arguments):
        """The words of a command for the desk: `ray` in the checkout, as the shipped file says to use it."""
        return "bash", "-c", 'cd "$0" && RAY_UP_enable_autoscaler_v2=0 exec ray "$@"', hosts.ROOT, *arguments

    def running(self, word):
        """How many processes of that name every worker machine has."""
        return [len(worker.processes(word)) for worker in self.workers]


@pytest.fixture(scope="module")
def possible():
    if reason := hosts.missing():
        pytest.skip(reason)


@pytest.fixture(scope="module")
def inline(possible, tmp_path_factory):
    """The run folder of the same run in one process, which goes on while the cluster comes up."""
    folder = tmp_path_factory.mktemp("runs") / "inline"
    command = [sys.executable, "-m", "icrl_dist.cli", *TRAIN, "--engine", "inline", "--out", folder]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:

        def finished():
            assert process.wait(timeout=60) == 0
            return folder

        yield finished


@pytest.fixture(scope="module")
def cluster(tmp_path_factory, inline):
    """The steps that stand at the head of the shipped file; when all is over, nothing of it is left."""
    folder = tmp_path_factory.mktemp("cluster")
    with hosts.running(folder, ["desk", "head", "worker-a", "worker-b"]) as machines:
        desk, head, *workers = machines
        namespaces = set().union(*(namespaces_of(machine.init.pid) for machine in machines))
        assert len(namespaces) == 3 * len(machines)
        (desk.home / "onprem.yaml").write_text(filled_in(head, workers))
        desk.run(hosts.ROOT / "deploy" / "zenoh" / "certificates.sh", Cluster.CERTIFICATES, head.address)
        desk.run(*Cluster.ray("get-auth-token", "--generate"))
        desk.run(*Cluster.ray("up", "-y", "--no-config-cache", Cluster.FILE))
        yield Cluster(desk, head, tuple(workers))
    assert namespaces.isdisjoint(set().union(*map(namespaces_of, psutil.pids())))
    assert str(folder) not in Path("/proc/mounts").read_text()


def namespaces_of(process):
    with contextlib.suppress(OSError):  # it has ended meanwhile
        return {(Path("/proc") / str(process) / "ns" / kind).readlink() for kind in ("net", "mnt", "pid")}
    return set()


def wait_until(condition, what, timeout=60):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {timeout} s"
        time.sleep(0.1)


def test_the_machines_join_and_strangers_are_kept_out(cluster):
    wait_until(lambda: cluster.running("raylet/raylet") == [1, 1], "a raylet on each worker machine")
    refused = subprocess.run(
        cluster.desk.command("env", "RAY_AUTH_MODE=disabled", "ray", "status", f"--address={cluster.head.address}:6379"),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert refused.returncode != 0 and "Unauthenticated" in refused.stdout, refused.stdout


def test_a_run_on_the_cluster_equals_one_in_one_process(cluster, inline, tmp_path):
    there = ["--address", "auto", "--actors", "2", "--out", f"{hosts.HOME}/runs/smoke"]
    there += ["--stream.endpoint", f"tls/{cluster.head.address}:7447", "--stream.certificates", cluster.CERTIFICATES]
    command = cluster.desk.command(*cluster.ray("exec", cluster.FILE, " ".join(["icrl-dist", *TRAIN, *there])))
    output = tmp_path / "output"
    with output.open("w") as file, subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT) as process:
        wait_until(lambda: cluster.running("_Host.work") == [1, 1] or process.poll() is not None, "a worker on each machine")
        assert process.poll() is None and not cluster.head.processes("_Host.work"), output.read_text()
        assert process.wait(timeout=60) == 0, output.read_text()
    result, expected = (
        json.loads((folder / "result.json").read_text()) for folder in (cluster.head.home / "runs" / "smoke", inline())
    )
    for name in ("dataset_digest", "weights_digest", "trajectories"):
        assert result[name] == expected[name], name


def test_ray_down_and_ray_stop_end_every_process(cluster):
    stop = "for host; do ssh -i ~/.ssh/id_ed25519 -o StrictHostKeyChecking=no $host icrl-dist/.venv/bin/ray stop & done; wait"
    cluster.desk.run(*cluster.ray("down", "-y", cluster.FILE))
    assert not [p.name() for p in cluster.head.processes("") if p.name() != "sshd"]
    cluster.desk.run("bash", "-c", stop, "stop", *(worker.address for worker in cluster.workers))
    for worker in cluster.workers:
        assert not [p.name() for p in worker.processes("") if p.name() != "sshd"]
