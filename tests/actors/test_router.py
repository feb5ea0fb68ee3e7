"""A node's router: its workers reach the learner through it, and the learner's access rules apply to them."""

import contextlib
import functools
import socket

import pytest

from actors import router
from icrl_dist.stream import security
from icrl_dist.stream.link import LinkError, StreamKeys, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink
from tests import certificates
from tests.contracts.link_battery import eventually

KEYS = StreamKeys("run")


def free_address():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def connected(tmp_path, monkeypatch):
    """A learner with TLS and access rules, and two workers that connect through a router."""
    folder, where = certificates.make(tmp_path / "certificates"), free_address()
    with contextlib.ExitStack() as stack:
        learner = stack.enter_context(ZenohLink.listen("tls/127.0.0.1:0", security.learner(folder, KEYS.run)))
        learner.serve(KEYS.data, lambda query: query.reply(b"stored " + query.payload))
        stack.enter_context(router.run(where, learner.endpoints[0], folder, 20.0))
        monkeypatch.setenv(router.VARIABLE, where)
        endpoint, settings = router.connection(learner.endpoints[0], folder)
        assert (endpoint, settings) == (where, {})
        yield learner, [stack.enter_context(ZenohLink.connect(endpoint, 20.0, settings)) for _ in range(2)]


def test_all_messages_of_a_worker_pass_the_router(connected):
    learner, workers = connected
    liveliness, heartbeats, weights = [], [], []
    learner.watch(KEYS.alive_all, lambda worker, alive: liveliness.append((worker, alive)))
    learner.subscribe(KEYS.monitor_all, lambda key, payload: heartbeats.append(payload))
    for number, worker in enumerate(workers):
        worker.announce(KEYS.alive(f"w{number}"))
        worker.subscribe(KEYS.weights, lambda _, payload: weights.append(payload))
        eventually(functools.partial(_is_served, worker))
    eventually(lambda: sorted(liveliness) == [("w0", True), ("w1", True)])
    eventually(lambda: learner.publish(KEYS.weights, b"W", droppable=False) or len(weights) >= 2)
    eventually(lambda: workers[0].publish(KEYS.monitor("worker/w0"), b"beat", droppable=True) or heartbeats)
    workers[1].close()
    eventually(lambda: liveliness[-1] == ("w1", False))


def _is_served(worker):
    with contextlib.suppress(Unanswered):
        return worker.request(KEYS.data, b"one", timeout_s=2.0) == b"stored one"


def test_the_learners_access_rules_apply_behind_the_router(connected):
    learner, workers = connected
    eventually(functools.partial(_is_served, workers[0]))
    answers, weights = [], []
    learner.subscribe(KEYS.weights, lambda _, payload: weights.append(payload))
    workers[0].publish(KEYS.weights, b"false", droppable=False)
    learner.serve("icrl/run/secret", lambda query: query.reply(b"secret"))
    with pytest.raises(Unanswered):
        answers.append(workers[1].request("icrl/run/secret", b"", timeout_s=1.0))
    assert not answers and not weights


def test_only_loopback_addresses_are_accepted_and_a_missing_learner_is_reported(monkeypatch):
    with pytest.raises(LinkError, match="a router must listen on a loopback address"):
        router.run("tcp/0.0.0.0:7448", "tls/192.0.2.1:7447", "")
    monkeypatch.setenv(router.VARIABLE, "tcp/192.0.2.1:7448")
    with pytest.raises(LinkError, match=r"ICRL_ROUTER = 'tcp/192.0.2.1:7448'"):
        router.connection("tls/h:7447", "")
    with pytest.raises(LinkError, match=r"cannot connect to tcp/127\.0\.0\.1"):
        router.run(free_address(), free_address(), "", 0.5)
    monkeypatch.delenv(router.VARIABLE)
    assert router.connection("tcp/127.0.0.1:7447", "") == ("tcp/127.0.0.1:7447", {})
