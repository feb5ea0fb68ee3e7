"""Contract tests of Link: a test class inherits them and provides the fixture ``links``."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import pytest

from icrl_dist.stream.link import Link, LinkError, Outcome, Query, Refused, StreamKeys, Unanswered

KEYS = StreamKeys("battery")


class Links(Protocol):
    """The learner's link and any number of workers' links, all connected."""

    learner: Link

    def worker(self) -> Link: ...

    def settle(self) -> None:
        """Wait until every link has received the declarations of the others."""


def eventually(condition: Callable[[], object], seconds: float = 30.0) -> None:
    """Wait until the condition holds; fail after ``seconds``."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"the condition does not hold after {seconds} s"
        time.sleep(0.005)


def refuse_all(reason: str) -> Callable[[Query], None]:
    return lambda query: query.refuse(reason)


class LinkBattery:
    @pytest.fixture
    def links(self) -> Iterator[Links]:
        raise NotImplementedError

    def test_a_request_is_answered(self, links: Links) -> None:
        links.learner.serve(KEYS.work, lambda query: query.reply(query.key.encode() + b"|" + query.payload))
        worker = links.worker()
        links.settle()
        assert worker.request(KEYS.work, b"\x00hi", 5.0) == KEYS.work.encode() + b"|\x00hi"
        assert worker.request(KEYS.work, b"", 5.0) == KEYS.work.encode() + b"|"

    def test_a_refusal_carries_its_reason(self, links: Links) -> None:
        links.learner.serve(KEYS.work, refuse_all("shape: é"))
        worker = links.worker()
        links.settle()
        with pytest.raises(Refused) as caught:
            worker.request(KEYS.work, b"", 5.0)
        assert caught.value.reason == "shape: é"

    def test_a_request_that_no_process_serves_is_unanswered(self, links: Links) -> None:
        worker, start = links.worker(), time.monotonic()
        with pytest.raises(Unanswered):
            worker.request(KEYS.work, b"", 30.0)
        assert time.monotonic() - start < 10

    def test_a_request_without_a_reply_is_unanswered_at_the_timeout(self, links: Links) -> None:
        held: list[Query] = []
        links.learner.serve(KEYS.work, held.append)
        worker = links.worker()
        links.settle()
        start = time.monotonic()
        with pytest.raises(Unanswered):
            worker.request(KEYS.work, b"", 0.3)
        assert 0.25 < time.monotonic() - start < 10
        eventually(lambda: held)
        held[0].reply(b"too late")

    def test_an_answer_may_come_later_from_another_thread(self, links: Links) -> None:
        links.learner.serve(KEYS.work, lambda query: threading.Timer(0.1, query.reply, [b"later"]).start())
        worker = links.worker()
        links.settle()
        assert worker.request(KEYS.work, b"", 5.0) == b"later"

    def test_a_second_answer_raises(self, links: Links) -> None:
        held: list[Query] = []
        links.learner.serve(KEYS.work, held.append)
        worker, outcomes = links.worker(), list[Outcome]()
        links.settle()
        worker.send(KEYS.work, b"", 5.0, outcomes.append)
        eventually(lambda: held)
        held[0].reply(b"once")
        for again in (lambda: held[0].reply(b"twice"), lambda: held[0].refuse("twice")):
            with pytest.raises(RuntimeError, match="already"):
                again()
        eventually(lambda: outcomes == [b"once"])

    def test_an_error_in_a_handler_is_the_answer(self, links: Links, caplog: pytest.LogCaptureFixture) -> None:
        def broken(query: Query) -> None:
            raise KeyError("no such thing")

        links.learner.serve(KEYS.work, broken)
        worker = links.worker()
        links.settle()
        with pytest.raises(Refused, match="error: KeyError"):
            worker.request(KEYS.work, b"", 5.0)
        assert "no such thing" in caplog.text

    def test_two_hundred_requests_are_each_answered_once_on_another_thread(self, links: Links) -> None:
        links.learner.serve(KEYS.data, lambda query: query.reply(query.payload))
        worker, answers, threads = links.worker(), list[Outcome](), set[int]()
        links.settle()

        def done(outcome: Outcome) -> None:
            threads.add(threading.get_ident())
            answers.append(outcome)

        for i in range(200):
            worker.send(KEYS.data, b"%d" % i, 60.0, done)
            worker.send("icrl/battery/unserved", b"", 60.0, done)
        eventually(lambda: len(answers) == 400, 60.0)
        time.sleep(0.05)
        assert sorted(a for a in answers if isinstance(a, bytes)) == sorted(b"%d" % i for i in range(200))
        assert sum(isinstance(a, Unanswered) for a in answers) == 200
        assert threading.get_ident() not in threads

    def test_subscribers_receive_matching_messages(self, links: Links) -> None:
        received: list[tuple[str, bytes]] = []
        exact: list[tuple[str, bytes]] = []
        tap, worker = links.worker(), links.worker()
        tap.subscribe(KEYS.monitor_all, lambda key, payload: received.append((key, payload)))
        tap.subscribe(KEYS.weights, lambda key, payload: exact.append((key, payload)))
        links.settle()
        worker.publish(KEYS.monitor("worker/w0"), b"1", droppable=True)
        links.learner.publish(KEYS.monitor("learner"), b"2", droppable=True)
        links.learner.publish(KEYS.weights, b"3", droppable=False)
        links.learner.publish(KEYS.weights_latest, b"4", droppable=False)
        eventually(lambda: len(received) == 2 and len(exact) == 1)
        assert sorted(received) == [(KEYS.monitor("learner"), b"2"), (KEYS.monitor("worker/w0"), b"1")]
        assert exact == [(KEYS.weights, b"3")]

    def test_has_subscribers_follows_subscriptions(self, links: Links) -> None:
        belief, other = KEYS.monitor("belief/w0"), KEYS.monitor("belief/w1")
        tap, worker = links.worker(), links.worker()
        tap.subscribe(KEYS.monitor("trajectories/w0"), lambda key, payload: None)
        links.settle()
        assert not worker.has_subscribers(belief)
        links.settle()
        assert not worker.has_subscribers(belief), "the subscriber has another key"
        tap.subscribe(belief, lambda key, payload: None)
        eventually(lambda: worker.has_subscribers(belief))
        assert not worker.has_subscribers(other)
        everything = links.worker()
        everything.subscribe(KEYS.monitor_all, lambda key, payload: None)
        eventually(lambda: worker.has_subscribers(other))
        everything.close()
        eventually(lambda: not worker.has_subscribers(other))
        assert worker.has_subscribers(belief)
        tap.close()
        eventually(lambda: not worker.has_subscribers(belief))

    def test_reliable_messages_wait_for_a_slow_subscriber(self, links: Links) -> None:
        received: list[int] = []
        worker = links.worker()

        def slow(key: str, payload: bytes) -> None:
            time.sleep(0.0005)
            received.append(int(payload))

        worker.subscribe(KEYS.weights, slow)
        links.settle()
        for i in range(1500):
            links.learner.publish(KEYS.weights, b"%d" % i, droppable=False)
        eventually(lambda: len(received) == 1500, 60.0)
        assert received == list(range(1500))

    def test_a_blocked_monitor_queues_a_bounded_number_of_messages(self, links: Links) -> None:
        tap, other, released, received = links.worker(), links.worker(), threading.Event(), list[int]()

        def receive(key: str, payload: bytes) -> None:
            if released.wait(60):
                received.append(len(payload))

        tap.subscribe(KEYS.monitor_all, receive)
        arrived = threading.Event()
        tap.subscribe(KEYS.weights, lambda key, payload: arrived.set())
        links.settle()
        for _ in range(1500):
            other.publish(KEYS.monitor("event"), b"x", droppable=False)
        other.publish(KEYS.weights, b"", droppable=False)  # arrives after the others
        assert arrived.wait(30)
        released.set()
        eventually(lambda: len(received) > 1000)
        time.sleep(0.1)
        assert len(received) <= 1025

    def test_a_blocked_monitor_delays_no_other_link(self, links: Links) -> None:
        tap, worker, released = links.worker(), links.worker(), threading.Event()

        def block(key: str, payload: bytes) -> None:
            released.wait(60)

        tap.subscribe(KEYS.monitor_all, block)
        links.learner.subscribe(KEYS.monitor_all, block)
        links.learner.serve(KEYS.data, lambda query: query.reply(b"stored"))
        links.settle()
        start, slowest = time.monotonic(), 0.0
        for _ in range(3000):
            before = time.monotonic()
            worker.publish(KEYS.monitor("trajectories/w0"), bytes(500), droppable=True)
            slowest = max(slowest, time.monotonic() - before)
        assert slowest < 10
        for _ in range(50):
            assert worker.request(KEYS.data, bytes(24_000), 20.0) == b"stored"
        assert time.monotonic() - start < 30.0
        released.set()

    def test_liveliness_tokens_appear_and_go(self, links: Links) -> None:
        early, seen = links.worker(), list[tuple[str, bool]]()
        early.announce(KEYS.alive("early"))
        links.settle()
        links.learner.watch(KEYS.alive_all, lambda worker, alive: seen.append((worker, alive)))
        eventually(lambda: seen == [("early", True)])
        late = links.worker()
        late.announce(KEYS.alive("late"))
        eventually(lambda: seen[1:] == [("late", True)])
        early.close()
        eventually(lambda: seen[2:] == [("early", False)])
        late.close()
        eventually(lambda: seen[3:] == [("late", False)])

    def test_closing_ends_pending_requests_and_may_be_repeated(self, links: Links) -> None:
        held: list[Query] = []
        links.learner.serve(KEYS.work, held.append)
        outcomes: list[Outcome] = []
        links.settle()
        with links.worker() as worker:
            links.settle()
            worker.send(KEYS.work, b"", 60.0, outcomes.append)
            eventually(lambda: held)
        eventually(lambda: len(outcomes) == 1)
        assert isinstance(outcomes[0], Unanswered)
        held[0].reply(b"too late")
        worker.close()
        for use in (
            lambda: worker.request(KEYS.work, b"", 1.0),
            lambda: worker.publish(KEYS.weights, b"", droppable=True),
            lambda: worker.has_subscribers(KEYS.weights),
            lambda: worker.serve(KEYS.work, held.append),
            lambda: worker.announce(KEYS.alive("w")),
        ):
            with pytest.raises(LinkError, match="closed"):
                use()
