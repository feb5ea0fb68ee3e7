"""A fake Ray that only records placements, and fixtures for a fleet on it."""

import socket
import sys
from types import SimpleNamespace

import pytest

from actors import cluster, fleet, local, missing
from icrl_dist.diagnostics import node_facts

REACH = node_facts.reach
NEEDED = {"problems/toy": "problem 'toy'"}
LOOPBACK = "tcp/127.0.0.1:0"
OWN_FACTS = {**node_facts.facts(), "decoder": ""}


class FakeJobConfig:
    def __init__(self, _py_driver_sys_path):
        pass


class FakeRay:
    """A cluster of nodes with ``cores`` each; ``answers`` change the facts that a node returns, or are raised."""

    exceptions = SimpleNamespace(
        AuthenticationError=PermissionError, RayActorError=ChildProcessError, RayTaskError=ModuleNotFoundError
    )
    job_config = SimpleNamespace(JobConfig=FakeJobConfig)
    util = SimpleNamespace(
        scheduling_strategies=SimpleNamespace(NodeAffinitySchedulingStrategy=lambda node, soft: (node, soft))
    )

    _private = SimpleNamespace(utils=SimpleNamespace(set_sigterm_handler=lambda handler: None))

    def __init__(self, *cores):
        self.cores = dict(enumerate(cores))
        """Cores of each node; None: the node has left."""
        self.placed, self.errors, self.killed = [], {}, []
        self.answers = {}
        self.unreachable, self.slow = set(), set()
        """Numbers of nodes whose Ray process cannot be reached, and of nodes that do not answer a check yet."""

    def is_initialized(self):
        return False

    def init(self, address=None, **options):
        if address == "192.0.2.99:6379":
            raise ConnectionError("no answer")

    def get_runtime_context(self):
        return SimpleNamespace(gcs_address="10.0.0.250:6379")

    def nodes(self):
        return [
            {
                "NodeID": f"n{i}",
                "Alive": cores is not None,
                "NodeManagerAddress": f"10.0.0.{i}",
                "NodeManagerPort": 1,
                "Resources": {"CPU": cores},
            }
            for i, cores in self.cores.items()
        ]

    def reach(self, host, port, timeout_s=3.0):
        if not host.startswith("10.0.0."):
            return REACH(host, port, timeout_s)
        return "timed out" if int(host.split(".")[-1]) in self.unreachable else ""

    def remote(self, num_cpus, scheduling_strategy, **options):
        node, soft = ("", False) if scheduling_strategy == "SPREAD" else scheduling_strategy
        assert soft is False

        def decorate(function_or_class):
            if function_or_class is node_facts.facts:
                return SimpleNamespace(remote=lambda certificates, ports: ("facts", node, tuple(ports)))
            self.placed.append((node, num_cpus))
            work = SimpleNamespace(remote=lambda endpoint, run_name, name, *_: ("work", node, name))
            return SimpleNamespace(remote=lambda: SimpleNamespace(work=work))

        return decorate

    def wait(self, running, **_):
        answered = lambda node: node not in {f"n{i}" for i in self.slow}  # noqa: E731
        return [one for one in running if one in self.errors or (one[0] == "facts" and answered(one[1]))], []

    def get(self, one):
        if one[0] == "work":
            raise self.errors.pop(one)
        _, node, ports = one
        unreached = [node_facts.reach(*p) for p in ports if p[1] and node_facts.reach(*p)]
        facts = {**OWN_FACTS, "host": node, "unreached": unreached}
        changed = self.answers.get(node, {})
        if isinstance(changed, Exception):
            raise changed
        return {**facts, **changed}

    def kill(self, actor):
        self.killed.append(actor)

    def shutdown(self):
        pass


class FakeSession:
    """Ray's processes on this machine; ``cause``: why only a restart helps."""

    made: "FakeSession"

    def __init__(self, ray, note, stopped, **options):
        FakeSession.made = self
        self.cause, self.restarts, self.closed = "", 0, False

    def failure(self):
        return self.cause

    def restart(self):
        self.cause, self.restarts = "", self.restarts + 1

    def close(self):
        self.closed = True


@pytest.fixture
def new_fleet(monkeypatch):
    """``new_fleet(ray, actors)``: a fleet on a fake Ray, without waiting times."""
    monkeypatch.setattr(fleet, "_SETTINGS", {})  # they would stay set for the other tests of this process
    monkeypatch.setattr(fleet, "_LOCAL_SETTINGS", {})
    monkeypatch.setattr(fleet, "_PAUSE_S", 0.001)
    monkeypatch.setattr(fleet, "Session", FakeSession)
    monkeypatch.setattr(fleet, "require_cluster", lambda address: None)
    monkeypatch.setattr(local, "protect_token", lambda: None)
    monkeypatch.setattr(cluster, "REFRESH_S", 0.0)
    monkeypatch.setattr(cluster, "RETRY_S", 0.0)
    monkeypatch.setattr(cluster, "UNREACHED_S", 0.0)
    monkeypatch.setattr(fleet, "RECHECK_S", 0.0)
    expected = missing.ExpectedNodes()
    monkeypatch.setattr(missing, "expected", lambda: expected)
    for name, value in (("NOTE_S", -1.0), ("REPORT_MISSING_S", 1e9), ("JOIN_S", 1e9)):
        monkeypatch.setattr(fleet, name, value)

    def new(ray, actors, address="auto", restarts=1, **options):
        nonlocal expected
        expected = missing.ExpectedNodes(*options.pop("expected", ((), 0)))
        monkeypatch.setitem(sys.modules, "ray", ray)
        monkeypatch.setattr(node_facts, "reach", ray.reach)
        return fleet.Fleet(actors, restarts, address, **options)

    return new


@pytest.fixture
def local_name(monkeypatch):
    """The name ``localtest`` of this machine, which does not count as loopback."""
    resolve, listen = socket.getaddrinfo, socket.create_server
    own = lambda host: "127.0.0.1" if host == "localtest" else host  # noqa: E731
    monkeypatch.setattr(socket, "getaddrinfo", lambda host, *a, **k: resolve(own(host), *a, **k))
    monkeypatch.setattr(socket, "create_server", lambda address, **options: listen((own(address[0]), 0), **options))


def gather(fleet, notes, endpoint="tls/localtest:0", turns=None, kernel=False):
    """Wait for the nodes, at most ``turns`` times, and start the run."""
    left = [turns]

    def stopped():
        if left[0] is not None:
            left[0] -= 1
            return left[0] < 0
        return False

    fleet.gather(endpoint, "", "", notes.append, stopped, NEEDED, kernel)
    fleet.start(endpoint, "run")


def placements(ray):
    return [node for node, _ in ray.placed]
