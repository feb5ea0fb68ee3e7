"""The doctor's questions to a live cluster, against machines that answer badly."""

import re
import socket
import sys
from types import SimpleNamespace

import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import cluster_nodes, doctor, node_facts
from icrl_dist.diagnostics.checks import table
from icrl_dist.stream import endpoints

HERE = node_facts.facts()


class Answering:
    """Two machines, a and b; what b says of itself is changed by ``answer``."""

    util = SimpleNamespace(
        scheduling_strategies=SimpleNamespace(NodeAffinitySchedulingStrategy=lambda node, soft: (node, soft))
    )

    def __init__(self, answer):
        self.answer, self.asked = answer, {}

    exceptions = SimpleNamespace(AuthenticationError=PermissionError)

    def init(self, **options):
        pass

    def shutdown(self):
        pass

    def nodes(self):
        ports = {"NodeManagerPort": 1, "ObjectManagerPort": 2}
        some = {"Alive": True, "Resources": {"CPU": 1}, **ports}
        return [{**some, "NodeID": n, "NodeManagerAddress": f"10.0.0.{n}"} for n in "ab"] + [{"Alive": False}]

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
        now = cluster_nodes.time.time() + changed.get("ahead_s", 0.0)
        return {**HERE, "time": now, "host": node, "unreached": (), "certificates": "", **changed}


@pytest.fixture
def asked(monkeypatch):
    """``asked(endpoint)``: what the doctor says of a healthy cluster, and the ports that machine b was to reach."""
    ray = Answering({})
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(doctor, "need_ray_token", lambda address: None)

    def ask(endpoint):
        return doctor.diagnose_cluster("auto", endpoint, ""), ray.asked.get("b")

    return ask


OTHERS = [("10.0.0.a", 6379), ("10.0.0.a", 1), ("10.0.0.a", 2)]


def test_a_learner_that_only_the_head_reaches_is_not_looked_for_by_others(asked):
    findings, ports = asked("tcp/127.0.0.1:0")
    assert ports == OTHERS and all(finding.ok is not False for finding in findings)
    assert re.search(r"warn +stream endpoint +tcp/127.0.0.1:0 is this machine's alone.*-> .*--endpoint tls/", table(findings))
    assert len(findings) == 11 and "reaches Ray's and 2 of the other" in table(findings)


def test_every_machine_is_examined_although_a_run_has_the_port(asked, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        monkeypatch.setattr(endpoints.Endpoint, "loopback", False)
        findings, ports = asked(f"tls/127.0.0.1:{port}")
    assert ports == [("127.0.0.1", port), *OTHERS] and all(finding.ok is not False for finding in findings)
    assert "Address already in use" in findings[0].value and len(findings) == 11


def test_an_address_that_is_not_the_heads_is_a_fault_and_every_machine_is_examined(asked):
    findings, ports = asked("tls/192.0.2.1:7447")
    assert ports == OTHERS and [f.name for f in findings if f.ok is False] == ["stream endpoint"] and len(findings) == 11


def test_an_endpoint_that_is_none_is_bad_usage(asked):
    with pytest.raises(ConfigError, match=r"--endpoint tcp://x:1: write it as"):
        asked("tcp://x:1")


def found(answer, certificates="folder"):
    ray = Answering(answer)
    findings = cluster_nodes.examine(ray, ("10.0.0.a", 7447), certificates)
    assert ray.asked["a"] == [("10.0.0.a", 7447), ("10.0.0.a", 6379), ("10.0.0.b", 1), ("10.0.0.b", 2)]
    return findings


def test_machines_that_are_fit_have_nothing_to_mend():
    findings = found({})
    assert len(findings) == 12 and all(finding.ok is not False and " (10.0.0." in finding.name for finding in findings)


@pytest.mark.parametrize(
    ("answer", "ok", "message"),
    [
        ({"code": "0" * 64}, False, r"b \(10.0.0.b\) versions .*icrl-dist's code 00000000 there.*-> run `ray up`"),
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
def test_what_ails_a_machine_is_one_line_with_its_remedy(answer, ok, message):
    findings = found(answer)
    (line, *_) = [table([f]) for f in findings if re.search(message, table([f]))]
    assert "\n" not in line and any(f.ok is ok and table([f]) == line for f in findings)
    assert all(f.ok is not False for f in findings if "10.0.0.a" in f.name)
