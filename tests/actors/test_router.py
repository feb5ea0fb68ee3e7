"""A machine's router: its workers reach the learner through it, under the learner's rules, and only they can."""

import contextlib
import socket

import pytest

from actors import router
from icrl_dist.stream import security
from icrl_dist.stream.link import LinkError, StreamKeys, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink
from tests import certificates
from tests.contracts.link_battery import eventually

KEYS = StreamKeys("run")


def free():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A learner behind TLS and its rules, and two workers behind a router."""
    folder, where = certificates.make(tmp_path / "certificates"), free()
    with contextlib.ExitStack() as stack:
        learner = stack.enter_context(ZenohLink.listen("tls/127.0.0.1:0", security.learner(folder, KEYS.run)))
        learner.serve(KEYS.data, lambda query: query.reply(b"stored " + query.payload))
        stack.enter_context(router.run(where, learner.endpoints[0], folder, 20.0))
        monkeypatch.setenv(router.VARIABLE, where)
        endpoint, settings = router.reached(learner.endpoints[0], folder)
        assert (endpoint, settings) == (where, {})
        yield learner, [stack.enter_context(ZenohLink.connect(endpoint, 20.0, settings)) for _ in range(2)]


def test_every_part_of_a_workers_life_goes_through_it(machine):
    learner, workers = machine
    seen, heard, weights = [], [], []
    learner.watch(KEYS.alive_all, lambda worker, alive: seen.append((worker, alive)))
    learner.subscribe(KEYS.monitor_all, lambda key, payload: heard.append(payload))
    for number, worker in enumerate(workers):
        worker.announce(KEYS.alive(f"w{number}"))
        worker.subscribe(KEYS.weights, lambda _, payload: weights.append(payload))
        eventually(lambda worker=worker: _ask(worker) == b"stored one")
    eventually(lambda: sorted(seen) == [("w0", True), ("w1", True)])
    eventually(lambda: learner.publish(KEYS.weights, b"W", droppable=False) or len(weights) >= 2)
    eventually(lambda: workers[0].publish(KEYS.monitor("worker/w0"), b"beat", droppable=True) or heard)
    workers[1].close()
    eventually(lambda: seen[-1] == ("w1", False))


def _ask(worker):
    with contextlib.suppress(Unanswered):
        return worker.request(KEYS.data, b"one", timeout_s=2.0)


def test_the_learners_rules_hold_for_who_is_behind_it(machine):
    learner, workers = machine
    eventually(lambda: _ask(workers[0]) == b"stored one")
    stolen, weights = [], []
    learner.subscribe(KEYS.weights, lambda _, payload: weights.append(payload))
    workers[0].publish(KEYS.weights, b"false", droppable=False)
    learner.serve("icrl/run/secret", lambda query: query.reply(b"secret"))
    with pytest.raises(Unanswered):
        stolen.append(workers[1].request("icrl/run/secret", b"", timeout_s=1.0))
    assert not stolen and not weights


def test_it_listens_to_this_machine_only_and_says_who_does_not_answer(monkeypatch):
    with pytest.raises(LinkError, match="nothing guards a router off this machine"):
        router.run("tcp/0.0.0.0:7448", "tls/192.0.2.1:7447", "")
    monkeypatch.setenv(router.VARIABLE, "tcp/192.0.2.1:7448")
    with pytest.raises(LinkError, match=r"ICRL_ROUTER = 'tcp/192.0.2.1:7448'"):
        router.reached("tls/h:7447", "")
    with pytest.raises(LinkError, match=r"cannot connect to tcp/127\.0\.0\.1"):
        router.run(free(), free(), "", 0.5)
    monkeypatch.delenv(router.VARIABLE)
    assert router.reached("tcp/127.0.0.1:7447", "") == ("tcp/127.0.0.1:7447", {})
