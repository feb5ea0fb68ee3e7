"""The doctor's checks of a running cluster, with a fake Ray whose nodes have faults."""

import re
import socket
import sys
import time
from types import SimpleNamespace

import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import cluster_nodes, doctor, node_facts
from icrl_dist.diagnostics.checks import table
from icrl_dist.stream import endpoints
from tests.actors.fake_ray import FakeJobConfig

HERE = {**node_facts.facts(), "decoder": ""}


class FakeRay:
    """Ray with two nodes, a and b; ``answer`` changes the facts of node b, or is the error that it raises."""

    util = SimpleNamespace(
        scheduling_strategies=SimpleNamespace(NodeAffinitySchedulingStrategy=lambda node, soft: (node, soft))
    )

    def __init__(self, answer):
        self.answer, self.asked = answer, {}

    exceptions = SimpleNamespace(AuthenticationError=PermissionError)
    job_config = SimpleNamespace(JobConfig=FakeJobConfig)

    def init(self, **options):
        pass

    def shutdown(self):
        pass

    def nodes(self):
        ports = {"NodeManagerPort": 1, "ObjectManagerPort": 2}
        node = {"Alive": True, "Resources": {"CPU": 1}, **ports}
        return [{**node, "NodeID": n, "NodeManagerAddress": f"10.0.0.{n}"} for n in "ab"] + [{"Alive": False}]

    def get_runtime_context(self):
        return SimpleNamespace(gcs_address="10.0.0.a:6379")

    def remote(self, scheduling_strategy, **options):
        node, _ = scheduling_strategy

        def ask(certificates="", ports=()):
            self.asked[node] = ports
            return node

        return lambda function: SimpleNamespace(remote=ask)

    def get(self, node, timeout):
        changed = self.answer if node == "b" else {}
        if isinstance(changed, Exception):
            raise changed
        now = time.time() + changed.get("ahead_s", 0.0)
        return {**HERE, "time": now, "host": node, "unreached": (), "certificates": "", **changed}


@pytest.fixture(autouse=True)
def a_compiled_decoder_here(monkeypatch):
    monkeypatch.setattr(node_facts, "library", lambda name: None)


@pytest.fixture
def diagnosed(monkeypatch):
    """``diagnosed(endpoint)``: the checks of a healthy cluster, and the ports that node b had to reach."""
    ray = FakeRay({})
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(doctor, "require_ray_token", lambda address: None)

    def diagnose(endpoint):
        return doctor.diagnose_cluster("auto", endpoint, ""), ray.asked.get("b")

    return diagnose


OTHERS = [("10.0.0.a", 6379), ("10.0.0.a", 1), ("10.0.0.a", 2)]


def test_a_loopback_endpoint_is_not_tried_by_other_nodes(diagnosed):
    checks, ports = diagnosed("tcp/127.0.0.1:0")
    assert ports == OTHERS and all(check.ok is not False for check in checks)
    assert re.search(
        r"warn +stream endpoint +tcp/127.0.0.1:0 can be reached from this machine only.*-> .*--endpoint tls/", table(checks)
    )
    assert len(checks) == 11 and "reaches Ray's and 2 of the other" in table(checks)


def test_every_node_is_checked_while_a_run_uses_the_port(diagnosed, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        monkeypatch.setattr(endpoints.Endpoint, "loopback", False)
        checks, ports = diagnosed(f"tls/127.0.0.1:{port}")
    assert ports == [("127.0.0.1", port), *OTHERS] and all(check.ok is not False for check in checks)
    assert "Address already in use" in checks[0].value and len(checks) == 11


def test_an_address_of_another_node_fails_and_every_node_is_checked(diagnosed):
    checks, ports = diagnosed("tls/192.0.2.1:7447")
    assert ports == OTHERS and [f.name for f in checks if f.ok is False] == ["stream endpoint"] and len(checks) == 11


def test_an_invalid_endpoint_is_bad_usage(diagnosed):
    with pytest.raises(ConfigError, match=r"--endpoint tcp://x:1: write it as"):
        diagnosed("tcp://x:1")


def checked(answer, certificates="folder"):
    ray = FakeRay(answer)
    checks = cluster_nodes.check_nodes(ray, ("10.0.0.a", 7447), certificates)
    assert ray.asked["a"] == [("10.0.0.a", 7447), ("10.0.0.a", 6379), ("10.0.0.b", 1), ("10.0.0.b", 2)]
    return checks


def test_healthy_nodes_pass_every_check():
    checks = checked({})
    assert len(checks) == 12 and all(check.ok is not False and " (10.0.0." in check.name for check in checks)


@pytest.mark.parametrize(
    ("answer", "ok", "message"),
    [
        ({"code": "0" * 64}, False, r"b \(10.0.0.b\) versions .*icrl-dist's code 00000000 there.*-> run `ray up`"),
        (
            {"decoder": "not compiled: run `make kernel`"},
            False,
            "decoder .*not compiled: run `make kernel`  -> or begin runs with",
        ),
        ({"time": 0.0}, False, r"clock .*s off  -> run ntpd"),
        ({"ahead_s": 30.0}, None, r"clock .*s off  -> run ntpd"),
        ({"shared_memory": 64 << 20}, None, r"shared memory +0.1 GiB free  -> mount"),
        ({"open_files": 1024}, None, "open files .*1024"),
        ({"certificates": "/c/worker.pem: expired"}, False, "/c/worker.pem: expired"),
        (
            {"unreached": ("10.0.0.a:7447: timed out", "10.0.0.a:1: refused")},
            False,
            "ports +10.0.0.a:7447: timed out  -> open it",
        ),
        (RuntimeError("one\nNo module named 'icrl_dist'"), False, "10.0.0.b +does not answer: No module named 'icrl_dist'"),
    ],
)
def test_each_fault_of_a_node_is_one_line_with_its_remedy(answer, ok, message):
    checks = checked(answer)
    (line, *_) = [table([f]) for f in checks if re.search(message, table([f]))]
    assert "\n" not in line and any(f.ok is ok and table([f]) == line for f in checks)
    assert all(f.ok is not False for f in checks if "10.0.0.a" in f.name)
