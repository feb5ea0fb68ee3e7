"""A cluster of simulated nodes, started with the shipped cluster file, and actions on it for tests."""

import contextlib
import json
import re
import subprocess
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import psutil

from icrl_dist.storage.dataset import Dataset
from tests.e2e import simulated_nodes
from tests.e2e.cluster import files
from tests.e2e.training import wait_for

# Small, so that most of the time goes to the cluster itself; a round is long enough for faults in the middle.
SMALL = "--pretrain.contexts 28 --pretrain.steps 4 --icaa.steps 4 --evaluate.episodes 1 --evaluate.seeds 1 --evaluate.p 0"
TRAIN = ["train", "smoke", *SMALL.split(), "--icaa.trials", "40"]


@dataclass(frozen=True)
class ShippedCluster:
    """The client on which `ray up` was run, the nodes that it started, and one node that the cluster file does not list."""

    client: simulated_nodes.SimulatedNode
    head: simulated_nodes.SimulatedNode
    workers: tuple[simulated_nodes.SimulatedNode, ...]
    late: simulated_nodes.SimulatedNode

    FILE = f"{simulated_nodes.HOME}/onprem.yaml"
    CERTIFICATES = f"{simulated_nodes.HOME}/.icrl/certificates"
    JOBS = "http://127.0.0.1:8265"
    """The job server of the head, through the tunnel."""

    @staticmethod
    def ray(*arguments):
        """Arguments of a command for the client: `ray` in the checkout, as the shipped file documents."""
        return "bash", "-c", 'cd "$0" && RAY_UP_enable_autoscaler_v2=0 exec ray "$@"', simulated_nodes.ROOT, *arguments

    def exec(self, command):
        """The command `ray exec` on the client, to be run on this machine."""
        return self.client.command(*self.ray("exec", self.FILE, command))

    def job(self, verb, *arguments):
        """The command `ray job` on the client, to be run on this machine; it needs the tunnel."""
        settings = ("RAY_AUTH_MODE=token", f"RAY_API_SERVER_ADDRESS={self.JOBS}", "PYTHONUNBUFFERED=1")
        return self.client.command("env", *settings, *self.ray("job", verb, *arguments))

    @contextlib.contextmanager
    def tunnel(self):
        """Open a tunnel from the client to the head with `ray dashboard`, and wait until it works."""
        words = self.client.command(*self.ray("dashboard", self.FILE))
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                wait_for(lambda: self.status_without_token() or process.poll() is not None, "the tunnel to the head")
                assert process.poll() is None, "`ray dashboard` ended"
                yield
            finally:
                for one in psutil.Process(process.pid).children(recursive=True):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        one.kill()
                process.kill()

    def status_without_token(self):
        """HTTP status of the job server for a request without a token; None without an answer."""
        ask = "import http.client, sys; c = http.client.HTTPConnection(sys.argv[1]); c.request('GET', '/api/jobs/')"
        words = self.client.command("python", "-S", "-c", f"{ask}; print(c.getresponse().status)", self.JOBS.split("/")[-1])
        done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        return None if done.returncode else int(done.stdout)

    def running(self, word):
        """Number of processes with that name on each worker node."""
        return [len(worker.processes(word)) for worker in self.workers]

    @contextlib.contextmanager
    def suspended(self):
        """Suspend all workers: the run makes no progress, however slow this machine is."""
        suspended = [process for node in self.workers for process in node.processes("WorkerActor.work")]
        for process in suspended:
            process.suspend()
        try:
            yield
        finally:
            for process in suspended:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.resume()

    def stored(self, name):
        """Bytes of the dataset of a run."""
        return sum(path.stat().st_size for path in (self.folder(name) / "dataset").glob("segment-*.frames"))

    @contextlib.contextmanager
    def cut_off(self):
        """Disconnect the network of all worker nodes."""
        try:
            for node in self.workers:
                node.run("ip", "link", "set", "eth0", "down")
            yield
        finally:
            for node in self.workers:
                node.run("ip", "link", "set", "eth0", "up")

    def train(self, name, *options):
        """The command that starts a run on the head with all workers of the cluster."""
        words = ["icrl-dist", *TRAIN, "--address", "auto", "--out", f"~/runs/{name}", *options]
        endpoint = f"tls/{self.head.address}:7447"
        return " ".join([*words, "--stream.endpoint", endpoint, "--stream.certificates", self.CERTIFICATES])

    def folder(self, name):
        return self.head.home / "runs" / name

    def result(self, name):
        return json.loads((self.folder(name) / "result.json").read_text())

    def workers_of(self, name):
        """Number of trajectories by each worker in the dataset of a run."""
        store = Dataset(self.folder(name) / "dataset", readonly=True)
        with contextlib.closing(store):
            return Counter(store.read(row.identity).worker for row in store.index)


@contextlib.contextmanager
def up(folder):
    """Start the cluster with the steps documented in the shipped file; afterwards check that nothing is left."""
    with simulated_nodes.running(folder, ["client", "head", "worker-a", "worker-b", "late"]) as nodes:
        client, head, *workers, late = nodes
        namespaces = set().union(*(_namespaces(node.init.pid) for node in nodes))
        assert len(namespaces) == 3 * len(nodes)
        (client.home / "onprem.yaml").write_text(files.filled_in(head, workers))
        client.run(simulated_nodes.ROOT / "deploy" / "zenoh" / "certificates.sh", ShippedCluster.CERTIFICATES, head.address)
        client.run(*ShippedCluster.ray("get-auth-token", "--generate"))
        started(lambda: client.run(*ShippedCluster.ray("up", "-y", "--no-config-cache", ShippedCluster.FILE), timeout=200))
        yield ShippedCluster(client, head, tuple(workers), late)
    assert namespaces.isdisjoint(set().union(*map(_namespaces, psutil.pids())))
    assert str(folder) not in Path("/proc/mounts").read_text()


def started(start, clear=lambda: None, times=3):
    """Call ``start``; after Ray's time limit of 30 s for the start of a node on a busy machine call ``clear`` and try again."""
    for left in reversed(range(times)):
        try:
            start()
            return
        except AssertionError as error:
            if not left or "timed out during startup" not in str(error):
                raise
            clear()


def _namespaces(process):
    with contextlib.suppress(OSError):  # the process has ended
        return {(Path("/proc") / str(process) / "ns" / kind).readlink() for kind in ("net", "mnt", "pid")}
    return set()


def one_line(text):
    """Terminal output without control sequences, on one line; `ray exec` runs its command in a terminal."""
    return re.sub(r"\s+", " ", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)).strip()


@contextlib.contextmanager
def underway(folder, words):
    """Run a command on this machine; yields its process and a function that returns its output so far."""
    output = folder / "output"
    with output.open("w") as file, subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT) as process:
        try:
            yield process, lambda: one_line(output.read_text())
        finally:
            process.kill()
