"""The contract tests on both links, and tests that need several processes."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from icrl_dist.stream import monitor_messages
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.dispatch import Dispatcher, Mailbox
from icrl_dist.stream.link import Link, LinkError, StreamKeys, Unanswered, matches
from icrl_dist.stream.memory_link import MemoryHub
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Adversary, Identity, Task, Trajectory, Variation
from tests.contracts.credit_battery import CreditBattery
from tests.contracts.link_battery import KEYS, LinkBattery, Links, eventually

ANYWHERE = "tcp/127.0.0.1:0"


class MemoryLinks:
    def __init__(self) -> None:
        self._hub = MemoryHub()
        self.learner: Link = self._hub.link()
        self.made = [self.learner]

    def worker(self) -> Link:
        self.made.append(self._hub.link())
        return self.made[-1]

    def settle(self) -> None:
        pass


class ZenohLinks:
    def __init__(self) -> None:
        self.learner: Link = ZenohLink.listen(ANYWHERE)
        self.learner.serve("icrl/settle", lambda query: query.reply(b""))
        self.made = [self.learner]

    def worker(self) -> Link:
        self.made.append(ZenohLink.connect(self.learner.endpoints[0], 5.0))
        return self.made[-1]

    def settle(self) -> None:
        for worker in self.made[1:]:
            worker.request("icrl/settle", b"", 30.0)  # answered after the worker's declarations have arrived
        time.sleep(0.1)  # time for the learner's declarations to arrive


class TestMemoryLink(LinkBattery, CreditBattery):
    @pytest.fixture
    def links(self) -> Iterator[Links]:
        links = MemoryLinks()
        yield links
        for link in links.made:
            link.close()


class TestZenohLink(LinkBattery, CreditBattery):
    @pytest.fixture
    def links(self) -> Iterator[Links]:
        links = ZenohLinks()
        yield links
        for link in reversed(links.made):
            link.close()


@pytest.mark.parametrize(
    ("key_expr", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/b/c", False),
        ("a/*", "a/b", True),
        ("a/*", "a", False),
        ("a/*", "a/b/c", False),
        ("a/**", "a", True),
        ("a/**", "a/b/c", True),
        ("**/c", "a/b/c", True),
        ("a/**/c", "a/c", True),
        ("a/**/c", "a/b/d", False),
    ],
)
def test_key_expressions(key_expr: str, key: str, expected: bool) -> None:
    assert matches(key_expr, key) is expected


def test_names_that_cannot_be_keys_are_refused() -> None:
    for name in ("", "a/b", "*", "a?", "a#", "a\nb"):
        with pytest.raises(ValueError, match="part of a key"):
            StreamKeys(name)
        with pytest.raises(ValueError, match="part of a key"):
            KEYS.alive(name)


def test_a_dispatcher_survives_an_action_that_raises(caplog: pytest.LogCaptureFixture) -> None:
    dispatcher, ran = Dispatcher("test"), list[str]()
    dispatcher.post(lambda: ran.append("later"), 1.0)
    dispatcher.post(lambda: 1 / 0)
    dispatcher.post(lambda: ran.append("now"))
    dispatcher.post(lambda: ran.append("never"), 60.0)
    eventually(lambda: ran == ["now", "later"])
    dispatcher.close()
    assert "ZeroDivisionError" in caplog.text


def test_a_port_in_use_and_an_absent_learner_are_named_in_the_error() -> None:
    with ZenohLink.listen(ANYWHERE) as link:
        endpoint = link.endpoints[0]
        with pytest.raises(LinkError, match=f"(?s){endpoint}.*in use.*another"):
            ZenohLink.listen(endpoint)
    with pytest.raises(LinkError, match=f"{endpoint} within 0.2 s.*learner runs"):
        ZenohLink.connect(endpoint, 0.2)
    for bad in ("nonsense", "tcp/127.0.0.1", "tcp/192.0.2.1:0"):
        with pytest.raises(LinkError, match=re.escape(bad)):
            ZenohLink.listen(bad)


def test_a_worker_reconnects_to_a_restarted_learner() -> None:
    first = ZenohLink.listen(ANYWHERE)
    endpoint, seen = first.endpoints[0], list[tuple[str, bool]]()
    with ZenohLink.connect(endpoint, 5.0) as worker:
        worker.announce(KEYS.alive("w0"))
        first.close()
        with pytest.raises(Unanswered):
            worker.request(KEYS.work, b"", 1.0)
        with ZenohLink.listen(endpoint) as second:
            second.serve(KEYS.work, lambda query: query.reply(b"again"))
            second.watch(KEYS.alive_all, lambda *event: seen.append(event))
            eventually(lambda: seen == [("w0", True)])
            assert worker.request(KEYS.work, b"", 5.0) == b"again"


WORKER = """
import sys, time
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
link = ZenohLink.connect(sys.argv[1], 10.0)
link.announce(StreamKeys("battery").alive("doomed"))
time.sleep(60)
"""

LEARNER = """
import sys, time
from icrl_dist.stream import batching
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
known = set(open(sys.argv[2]).read().split())
file = open(sys.argv[2], "a")
def store(query):
    name = query.payload.decode()
    if name not in known:
        known.add(name)
        print(name, file=file, flush=True)
    time.sleep(0.001)
    query.reply(b"stored")
def split_and_store(query):
    for part in batching.split(query, 1 << 20):
        store(part)
ZenohLink.listen(sys.argv[1]).serve(StreamKeys("battery").data, split_and_store)
time.sleep(60)
"""

UNCLOSED = """
import sys
from icrl_dist.stream.zenoh_link import ZenohLink
link = ZenohLink.connect(sys.argv[1], 10.0)
link.subscribe("icrl/**", lambda key, payload: None)
link.serve("icrl/x/y", lambda query: query.reply(b""))
"""


def run(script: str, *arguments: object) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", script, *map(str, arguments)])


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait(10)


def test_the_death_of_a_worker_is_reported() -> None:
    seen: list[tuple[str, bool]] = []
    with ZenohLink.listen(ANYWHERE) as learner:
        learner.watch(KEYS.alive_all, lambda *event: seen.append(event))
        worker = run(WORKER, learner.endpoints[0])
        try:
            eventually(lambda: seen == [("doomed", True)], 15.0)
        finally:
            kill(worker)
        eventually(lambda: seen[1:] == [("doomed", False)], 2.0)


def test_a_killed_and_restarted_learner_loses_nothing(tmp_path: Path) -> None:
    with ZenohLink.listen(ANYWHERE) as free:
        endpoint = free.endpoints[0]
    stored = tmp_path / "stored"
    stored.touch()
    learner = run(LEARNER, endpoint, stored)
    try:
        with ZenohLink.connect(endpoint, 15.0) as worker:
            sender, items = CreditSender(worker, KEYS.data, 8, 5.0), [b"%d" % i for i in range(800)]
            feeder = threading.Thread(target=lambda: list(map(sender.send, items)))
            feeder.start()
            eventually(lambda: sender.acknowledged > 200, 10.0)
            kill(learner)
            learner = run(LEARNER, endpoint, stored)
            feeder.join(30.0)
            sender.drain(10.0)
            sender.close()
            assert sender.resent > 0 and sender.acknowledged == 800
    finally:
        kill(learner)
    assert sorted(map(int, stored.read_text().split())) == list(range(800))


def test_a_process_that_does_not_close_its_link_still_exits() -> None:
    with ZenohLink.listen(ANYWHERE) as learner:
        assert run(UNCLOSED, learner.endpoints[0]).wait(15) == 0


def test_the_documented_tap_prints_a_line_a_trajectory(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "tap.md").read_text()
    found = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert found is not None
    script = tmp_path / "tap.py"
    script.write_text(found.group(1))
    episode = Trajectory(
        identity=Identity("adapt", 0, 3, 1, 7),
        variation=Variation(Task.of("darkroom", goal=(3, 4), size=10), Adversary.of("override", p=0.1)),
        policy_version=2,
        weights_digest="ab",
        worker="w0",
        observations=np.zeros((3, 2), np.float32),
        actions=np.zeros(2, np.int16),
        rewards=np.ones(2, np.float32),
        adversary=np.full(2, -1, np.int16),
        queries=np.zeros((0, 2), np.float32),
        labels=np.zeros((0, 5), np.float32),
        prev_actions=np.zeros(0, np.int16),
        prev_rewards=np.zeros(0, np.float32),
        origin="none",
    )
    with ZenohLink.listen(ANYWHERE) as learner:
        command = [sys.executable, str(script), learner.endpoints[0], "battery"]
        tap = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            lines: list[str] = []
            output = tap.stdout
            assert output is not None
            reader = threading.Thread(target=lambda: lines.append(output.readline()), daemon=True)
            reader.start()
            end = time.monotonic() + 15
            while not lines and time.monotonic() < end:
                learner.publish(KEYS.monitor("trajectories/w0"), monitor_messages.trajectories([episode], 5.0), droppable=True)
                time.sleep(0.05)
        finally:
            tap.kill()
            tap.communicate(timeout=10)
    assert json.loads(lines[0]) == {
        "identity": "adapt/0/3/1/7",
        "problem": "darkroom",
        "task": {"goal": [3, 4], "size": 10},
        "adversary": {"kind": "override", "p": 0.1},
        "episode_return": 2.0,
        "steps": 2,
        "policy_version": 2,
        "weights_digest": "ab",
        "worker": "w0",
        "time": 5.0,
    }


def test_the_queue_of_a_subscriber_is_bounded_in_bytes():
    began, released, received = threading.Event(), threading.Event(), []

    def slow(key, payload):
        began.set()
        released.wait(10)
        received.append(len(payload))

    mailbox = Mailbox(slow, capacity=10, max_bytes=100)
    mailbox.put("k", bytes(90), droppable=True)
    assert began.wait(10)  # the first message has left the queue
    for size in (101, 60, 60, 40, 1):
        mailbox.put("k", bytes(size), droppable=True)
    mailbox.put("k", bytes(500), droppable=False)
    released.set()
    eventually(lambda: len(received) == 4)
    mailbox.put("k", bytes(100), droppable=True)
    eventually(lambda: len(received) == 5)
    mailbox.close()
    assert received == [90, 60, 40, 500, 100] and mailbox.dropped == 3
