"""The shipped cluster file on hosts of this machine's own, and how the tests use them."""

import contextlib
import json
import re
import subprocess
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import psutil

from icrl_dist.storage.dataset import Dataset
from tests.e2e import hosts
from tests.e2e.cluster import files

# Small enough to leave most of the time to the cluster itself; a round is long enough to be in the middle of.
SMALL = "--pretrain.contexts 28 --pretrain.steps 4 --icaa.steps 4 --evaluate.episodes 1 --evaluate.seeds 1 --evaluate.p 0"
TRAIN = ["train", "smoke", *SMALL.split(), "--icaa.trials", "40"]


@dataclass(frozen=True)
class Cluster:
    """Machines that `ray up` was run for, the one it was run on, and one that the cluster file does not know."""

    desk: hosts.Host
    head: hosts.Host
    workers: tuple[hosts.Host, ...]
    late: hosts.Host

    FILE = f"{hosts.HOME}/onprem.yaml"
    CERTIFICATES = f"{hosts.HOME}/.icrl/certificates"
    JOBS = "http://127.0.0.1:8265"
    """The head's job server, by the tunnel."""

    @staticmethod
    def ray(*arguments):
        """The words of a command for the desk: `ray` in the checkout, as the shipped file says to use it."""
        return "bash", "-c", 'cd "$0" && RAY_UP_enable_autoscaler_v2=0 exec ray "$@"', hosts.ROOT, *arguments

    def exec(self, command):
        """The words of `ray exec`, for this machine."""
        return self.desk.command(*self.ray("exec", self.FILE, command))

    def job(self, verb, *arguments):
        """The words of `ray job`, for this machine; it needs the tunnel."""
        settings = ("RAY_AUTH_MODE=token", f"RAY_API_SERVER_ADDRESS={self.JOBS}", "PYTHONUNBUFFERED=1")
        return self.desk.command("env", *settings, *self.ray("job", verb, *arguments))

    @contextlib.contextmanager
    def tunnel(self):
        """`ray dashboard`, from the desk to the head, until it carries."""
        words = self.desk.command(*self.ray("dashboard", self.FILE))
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                wait_until(lambda: self.answers_strangers() or process.poll() is not None, "the tunnel to the head")
                assert process.poll() is None, "`ray dashboard` ended"
                yield
            finally:
                for one in [*psutil.Process(process.pid).children(recursive=True), process]:
                    with contextlib.suppress(psutil.NoSuchProcess):
                        one.kill()

    def answers_strangers(self):
        """The status with which the job server answers who has no token; None if nothing answers."""
        ask = "import http.client, sys; c = http.client.HTTPConnection(sys.argv[1]); c.request('GET', '/api/jobs/')"
        words = self.desk.command("python", "-S", "-c", f"{ask}; print(c.getresponse().status)", self.JOBS.split("/")[-1])
        done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        return None if done.returncode else int(done.stdout)

    def running(self, word):
        """How many processes of that name every worker machine has."""
        return [len(worker.processes(word)) for worker in self.workers]

    @contextlib.contextmanager
    def held(self):
        """Every worker stands still: no run gets on, however busy this machine is."""
        held = [process for machine in self.workers for process in machine.processes("_Host.work")]
        for process in held:
            process.suspend()
        try:
            yield
        finally:
            for process in held:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.resume()

    @contextlib.contextmanager
    def cut_off(self):
        """No worker machine has a link."""
        try:
            for machine in self.workers:
                machine.run("ip", "link", "set", "eth0", "down")
            yield
        finally:
            for machine in self.workers:
                machine.run("ip", "link", "set", "eth0", "up")

    def train(self, name, *options):
        """The command of a run on the head, by every worker that the cluster has."""
        words = ["icrl-dist", *TRAIN, "--address", "auto", "--out", f"~/runs/{name}", *options]
        endpoint = f"tls/{self.head.address}:7447"
        return " ".join([*words, "--stream.endpoint", endpoint, "--stream.certificates", self.CERTIFICATES])

    def folder(self, name):
        return self.head.home / "runs" / name

    def result(self, name):
        return json.loads((self.folder(name) / "result.json").read_text())

    def workers_of(self, name):
        """How many trajectories each worker of a run sent that are in its dataset."""
        store = Dataset(self.folder(name) / "dataset", readonly=True)
        with contextlib.closing(store):
            return Counter(store.read(row.identity).worker for row in store.index)


@contextlib.contextmanager
def up(folder):
    """The steps that stand at the head of the shipped file; when all is over, nothing of it is left."""
    with hosts.running(folder, ["desk", "head", "worker-a", "worker-b", "late"]) as machines:
        desk, head, *workers, late = machines
        namespaces = set().union(*(_namespaces(machine.init.pid) for machine in machines))
        assert len(namespaces) == 3 * len(machines)
        (desk.home / "onprem.yaml").write_text(files.filled_in(head, workers))
        desk.run(hosts.ROOT / "deploy" / "zenoh" / "certificates.sh", Cluster.CERTIFICATES, head.address)
        desk.run(*Cluster.ray("get-auth-token", "--generate"))
        started(lambda: desk.run(*Cluster.ray("up", "-y", "--no-config-cache", Cluster.FILE), timeout=200))
        yield Cluster(desk, head, tuple(workers), late)
    assert namespaces.isdisjoint(set().union(*map(_namespaces, psutil.pids())))
    assert str(folder) not in Path("/proc/mounts").read_text()


def started(start, clear=lambda: None, times=3):
    """``start``, and after ``clear`` again if a machine was so busy that Ray's 30 seconds for a node's start were over."""
    for left in reversed(range(times)):
        try:
            start()
            return
        except AssertionError as error:
            if not left or "timed out during startup" not in str(error):
                raise
            clear()


def _namespaces(process):
    with contextlib.suppress(OSError):  # it has ended meanwhile
        return {(Path("/proc") / str(process) / "ns" / kind).readlink() for kind in ("net", "mnt", "pid")}
    return set()


def wait_until(condition, what, timeout=250):
    deadline = time.monotonic() + timeout
    while True:
        began = time.monotonic()
        if condition():
            return
        assert began < deadline, f"{what}: not within {timeout} s"
        time.sleep(0.05 + 4 * (time.monotonic() - began))  # a fifth of a core at most


def plain(text):
    """What a terminal shows, on one line: `ray exec` gives the command one."""
    return re.sub(r"\s+", " ", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)).strip()


@contextlib.contextmanager
def underway(folder, words):
    """A command of this machine: its process, and a function that gives what it has printed."""
    output = folder / "output"
    with output.open("w") as file, subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT) as process:
        try:
            yield process, lambda: plain(output.read_text())
        finally:
            process.kill()
