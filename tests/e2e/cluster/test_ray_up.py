"""The cluster file that is shipped on hosts of this machine's own: a run, three faults, and nothing left behind.

One cluster serves all of it: `ray up` takes longer than a run.
"""

import contextlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from icrl_dist.store import Store
from tests.e2e import hosts
from tests.e2e.cluster import files

# Small enough to leave most of the time to the cluster itself.
SMALL = "--pretrain.contexts 28 --pretrain.steps 4 --icaa.steps 4 --evaluate.episodes 1 --evaluate.seeds 1"
TRAIN = ["train", "smoke", *SMALL.split(), "--icaa.trials", "60"]
CUT_S = 20.0

pytestmark = pytest.mark.timeout(600)  # five hosts on two cores, beside other tests


@dataclass(frozen=True)
class Cluster:
    """Machines that `ray up` was run for, the one it was run on, and one that the cluster file does not know."""

    desk: hosts.Host
    head: hosts.Host
    workers: tuple[hosts.Host, ...]
    late: hosts.Host

    FILE = f"{hosts.HOME}/onprem.yaml"
    CERTIFICATES = f"{hosts.HOME}/.icrl/certificates"

    @staticmethod
    def ray(*arguments):
        """The words of a command for the desk: `ray` in the checkout, as the shipped file says to use it."""
        return "bash", "-c", 'cd "$0" && RAY_UP_enable_autoscaler_v2=0 exec ray "$@"', hosts.ROOT, *arguments

    def running(self, word):
        """How many processes of that name every worker machine has."""
        return [len(worker.processes(word)) for worker in self.workers]

    def train(self, name, *options):
        """The command of a run on the head, by every worker that the cluster has."""
        words = ["icrl-dist", *TRAIN, "--address", "auto", "--out", f"{hosts.HOME}/runs/{name}", *options]
        endpoint = f"tls/{self.head.address}:7447"
        return " ".join([*words, "--stream.endpoint", endpoint, "--stream.certificates", self.CERTIFICATES])

    def folder(self, name):
        return self.head.home / "runs" / name

    def workers_of(self, name):
        """How many trajectories each worker of a run sent that are in its dataset."""
        store = Store(self.folder(name) / "dataset", readonly=True)
        with contextlib.closing(store):
            return Counter(store.read(row.identity).worker for row in store.ledger)


@pytest.fixture(scope="module")
def possible():
    if reason := hosts.missing():
        pytest.skip(reason)


@pytest.fixture(scope="module")
def inline(possible, tmp_path_factory):
    """The result of the same run in one process, which goes on beside the first run on the cluster."""
    folder = tmp_path_factory.mktemp("runs") / "inline"
    command = [sys.executable, "-m", "icrl_dist.cli", *TRAIN, "--engine", "inline", "--out", folder]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:

        def finished():
            assert process.wait(timeout=200) == 0
            return json.loads((folder / "result.json").read_text())

        yield finished


@pytest.fixture(scope="module")
def cluster(possible, tmp_path_factory):
    """The steps that stand at the head of the shipped file; when all is over, nothing of it is left."""
    folder = tmp_path_factory.mktemp("cluster")
    with hosts.running(folder, ["desk", "head", "worker-a", "worker-b", "late"]) as machines:
        desk, head, *workers, late = machines
        namespaces = set().union(*(namespaces_of(machine.init.pid) for machine in machines))
        assert len(namespaces) == 3 * len(machines)
        (desk.home / "onprem.yaml").write_text(files.filled_in(head, workers))
        desk.run(hosts.ROOT / "deploy" / "zenoh" / "certificates.sh", Cluster.CERTIFICATES, head.address)
        desk.run(*Cluster.ray("get-auth-token", "--generate"))
        bring_up(desk)
        yield Cluster(desk, head, tuple(workers), late)
    assert namespaces.isdisjoint(set().union(*map(namespaces_of, psutil.pids())))
    assert str(folder) not in Path("/proc/mounts").read_text()


def bring_up(desk, times=3):
    """`ray up`, again if a machine was so busy that Ray's 30 seconds for a node's start were over."""
    for left in reversed(range(times)):
        try:
            desk.run(*Cluster.ray("up", "-y", "--no-config-cache", Cluster.FILE), timeout=200)
            return
        except AssertionError as error:
            if not left or "timed out during startup" not in str(error):
                raise


def namespaces_of(process):
    with contextlib.suppress(OSError):  # it has ended meanwhile
        return {(Path("/proc") / str(process) / "ns" / kind).readlink() for kind in ("net", "mnt", "pid")}
    return set()


def wait_until(condition, what, timeout=100):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {timeout} s"
        time.sleep(0.05)


def plain(text):
    """What a terminal shows, on one line: `ray exec` gives the command one."""
    return re.sub(r"\s+", " ", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)).strip()


@contextlib.contextmanager
def underway(cluster, tmp_path, words):
    """A command on the desk: its process, and a function that gives what it has printed."""
    output = tmp_path / "output"
    with output.open("w") as file, subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT) as process:
        try:
            yield process, lambda: plain(output.read_text())
        finally:
            process.kill()


def exec_(cluster, command):
    return cluster.desk.command(*cluster.ray("exec", cluster.FILE, command))


def same(result, expected):
    for name in ("dataset_digest", "weights_digest", "trajectories"):
        assert result[name] == expected[name], name


def result_of(cluster, name):
    return json.loads((cluster.folder(name) / "result.json").read_text())


def test_the_machines_join_and_strangers_are_kept_out(cluster):
    wait_until(lambda: cluster.running("raylet/raylet") == [1, 1], "a raylet on each worker machine")
    refused = subprocess.run(
        cluster.desk.command("env", "RAY_AUTH_MODE=disabled", "ray", "status", f"--address={cluster.head.address}:6379"),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert refused.returncode != 0 and "Unauthenticated" in refused.stdout, refused.stdout


def test_a_run_on_the_cluster_equals_one_in_one_process_and_says_where_everything_is(cluster, inline, tmp_path):
    with underway(cluster, tmp_path, exec_(cluster, cluster.train("smoke"))) as (process, printed):
        wait_until(lambda: cluster.running("_Host.work") == [1, 1] or process.poll() is not None, "a worker on each machine")
        assert process.poll() is None and not cluster.head.processes("_Host.work"), printed()
        assert process.wait(timeout=100) == 0, printed()
    assert re.search(r"learner on head \(cpu, 1 threads\) listens at tls/", printed())
    assert re.search(r"workers: worker-[ab] \(10.0.0.[34]\): w0; worker-[ab] \(10.0.0.[34]\): w1", printed())
    same(result_of(cluster, "smoke"), inline())
    assert set(cluster.workers_of("smoke")) == {"w0", "w1"}


@pytest.mark.skipif(not files.JOBS, reason="`ray job submit` needs ray[default]: pip install '.[cluster]'")
def test_a_run_that_was_submitted_from_outside_is_the_same(cluster, inline, tmp_path):
    forward = cluster.desk.command(*cluster.ray("dashboard", cluster.FILE))
    with subprocess.Popen(forward, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as tunnel:
        try:
            with_token = ("env", "RAY_AUTH_MODE=token")
            connected = [*with_token, *cluster.ray("job", "list", "--address", "http://127.0.0.1:8265")]
            ask = lambda: subprocess.run(cluster.desk.command(*connected), capture_output=True).returncode == 0  # noqa: E731
            wait_until(ask, "the tunnel to the head")
            submit = ["job", "submit", "--address", "http://127.0.0.1:8265", "--", *cluster.train("submitted").split()]
            printed = cluster.desk.run(*with_token, *cluster.ray(*submit), timeout=150)
        finally:
            for process in [*psutil.Process(tunnel.pid).children(recursive=True), tunnel]:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
    assert "succeeded" in plain(printed)
    same(result_of(cluster, "submitted"), inline())


def test_machines_that_do_not_fit_or_have_no_token_stop_a_run_before_it_starts(cluster):
    def refused(*options, environment=""):
        words = f"{environment} {cluster.train('refused', *options)}"
        done = subprocess.run(exec_(cluster, words), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=100)
        lines = [plain(line) for line in done.stdout.splitlines() if plain(line).startswith("icrl-dist: ")]
        assert done.returncode != 0 and len(lines) == 1, done.stdout
        assert not cluster.folder("refused").exists(), "the same command could not be given again"
        return lines[0]

    assert "without a token anyone who reaches Ray's ports" in refused(environment="RAY_AUTH_MODE=disabled")
    worker = cluster.workers[0]
    key = worker.home / ".icrl" / "certificates" / "worker.key"
    key.rename(key.with_suffix(".away"))
    try:
        assert re.search(r"worker-a \(10.0.0.3\): .*worker.key: cannot be read", refused())
    finally:
        key.with_suffix(".away").rename(key)
    # A machine that cannot reach the learner's port, though Ray's.
    worker.run("ip", "route", "add", "blackhole", "10.0.0.77/32")
    assert "cannot reach the learner's port, 10.0.0.77:7447" in refused("--stream.connect", "tls/10.0.0.77:7447")


def test_20_seconds_without_a_link_change_nothing(cluster, inline, tmp_path):
    """Both workers are cut off in the middle of a round, so that the run cannot go on without them."""
    with underway(cluster, tmp_path, exec_(cluster, cluster.train("cut"))) as (process, printed):
        wait_until(lambda: "round 0" in printed() or process.poll() is not None, "the first round")
        began = time.monotonic()
        for worker in cluster.workers:
            worker.run("ip", "link", "set", "eth0", "down")
        time.sleep(max(0.0, CUT_S - (time.monotonic() - began)))
        assert process.poll() is None, printed()
        for worker in cluster.workers:
            worker.run("ip", "link", "set", "eth0", "up")
        assert process.wait(timeout=150) == 0, printed()
    same(result_of(cluster, "cut"), inline())


def test_killed_raylets_a_killed_learner_and_a_machine_that_joins_midway(cluster, inline, tmp_path):
    """All workers and the learner die in the middle of a round; a machine that nobody has told of does the rest."""
    with underway(cluster, tmp_path, exec_(cluster, cluster.train("killed"))) as (process, printed):
        wait_until(lambda: "round 0" in printed() or process.poll() is not None, "the first round")
        assert process.poll() is None, printed()
        for word, machines in (("raylet/raylet", cluster.workers), ("-m learner", (cluster.head,))):
            for machine in machines:
                for victim in machine.processes(word):
                    victim.kill()
        joins(cluster)
        assert process.wait(timeout=200) == 0, printed()
    result = result_of(cluster, "killed")
    same(result, inline())
    assert result["learner_deaths"] == 1 and "the learner died (exit code -9)" in printed()
    assert re.search(r"late \(10.0.0.5\): w\d", printed()), printed()
    assert set(cluster.workers_of("killed")) - {"w0", "w1"}, "nobody was needed but those that were killed"


def joins(cluster):
    """What the cluster file does on a worker, by hand."""
    late, head = cluster.late, cluster.head
    for folder in (".ray", ".icrl"):
        shutil.copytree(cluster.desk.home / folder, late.home / folder)
    start = f"RAY_AUTH_MODE=token RAY_worker_niceness=0 {hosts.CODE} ray start --address={head.address}:6379 --num-cpus=1"
    late.run("bash", "-c", f"ulimit -n $(ulimit -Hn); {start} --node-ip-address={late.address} --object-store-memory=104857600")


def test_ray_down_and_ray_stop_end_every_process(cluster):
    stop = "for host; do ssh -i ~/.ssh/id_ed25519 -o StrictHostKeyChecking=no $host icrl-dist/.venv/bin/ray stop & done; wait"
    cluster.desk.run(*cluster.ray("down", "-y", cluster.FILE))
    assert not [p.name() for p in cluster.head.processes("") if p.name() != "sshd"]
    cluster.desk.run("bash", "-c", stop, "stop", *(worker.address for worker in cluster.workers))
    cluster.late.run("ray", "stop")
    for worker in (*cluster.workers, cluster.late):
        assert not [p.name() for p in worker.processes("") if p.name() != "sshd"]
