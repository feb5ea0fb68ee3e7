"""What every Link must do; a test class inherits it and says how links are made."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
import pytest

from icrl_dist.stream import batching
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import Link, LinkError, Outcome, Query, Refused, StreamKeys, Unanswered

KEYS = StreamKeys("battery")


class Links(Protocol):
    """One learner's link and as many workers' links as asked for, all connected."""

    learner: Link

    def worker(self) -> Link: ...

    def settle(self) -> None:
        """Wait until what was declared is known everywhere."""


def eventually(condition: Callable[[], object], seconds: float = 30.0) -> None:
    """Wait for the condition, failing after so many seconds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"still not so after {seconds} s"
        time.sleep(0.005)


def refuse_all(reason: str) -> Callable[[Query], None]:
    return lambda query: query.refuse(reason)


def each(handler: Callable[[Query], object]) -> Callable[[Query], None]:
    """A handler of requests that gives their items to ``handler`` one by one."""

    def take_apart(query: Query) -> None:
        for part in batching.split(query, 1 << 20):
            handler(part)

    return take_apart


class Server:
    """Commits payloads, each once, and says by ``plan`` what becomes of each request."""

    def __init__(self, plan: Callable[[bytes, int], str]) -> None:
        self.committed: list[bytes] = []
        self.duplicates = 0
        self.requests: Counter[bytes] = Counter()
        self.held: list[Query] = []
        self._plan = plan

    def __call__(self, query: Query) -> None:
        payload = query.payload
        fate = self._plan(payload, self.requests[payload])
        self.requests[payload] += 1
        if fate == "busy":
            query.refuse("busy: full")
            return
        if fate == "lose":
            self.held.append(query)
            return
        if payload in self.committed:
            self.duplicates += 1
        else:
            self.committed.append(payload)
        if fate == "commit, lose":
            self.held.append(query)
        else:
            query.reply(b"stored")


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

    def test_nobody_there_is_unanswered(self, links: Links) -> None:
        worker, start = links.worker(), time.monotonic()
        with pytest.raises(Unanswered):
            worker.request(KEYS.work, b"", 30.0)
        assert time.monotonic() - start < 10

    def test_silence_is_unanswered_at_the_timeout(self, links: Links) -> None:
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

    def test_what_a_handler_raises_is_the_answer(self, links: Links, caplog: pytest.LogCaptureFixture) -> None:
        def broken(query: Query) -> None:
            raise KeyError("no such thing")

        links.learner.serve(KEYS.work, broken)
        worker = links.worker()
        links.settle()
        with pytest.raises(Refused, match="error: KeyError"):
            worker.request(KEYS.work, b"", 5.0)
        assert "no such thing" in caplog.text

    def test_two_hundred_requests_are_each_answered_once_off_the_callers_thread(self, links: Links) -> None:
        links.learner.serve(KEYS.data, lambda query: query.reply(query.payload))
        worker, answers, threads = links.worker(), list[Outcome](), set[int]()
        links.settle()

        def done(outcome: Outcome) -> None:
            threads.add(threading.get_ident())
            answers.append(outcome)

        for i in range(200):
            worker.send(KEYS.data, b"%d" % i, 60.0, done)
            worker.send("icrl/battery/nobody", b"", 60.0, done)
        eventually(lambda: len(answers) == 400, 60.0)
        time.sleep(0.05)
        assert sorted(a for a in answers if isinstance(a, bytes)) == sorted(b"%d" % i for i in range(200))
        assert sum(isinstance(a, Unanswered) for a in answers) == 200
        assert threading.get_ident() not in threads

    def test_subscribers_hear_what_matches(self, links: Links) -> None:
        heard: list[tuple[str, bytes]] = []
        exact: list[tuple[str, bytes]] = []
        tap, worker = links.worker(), links.worker()
        tap.subscribe(KEYS.monitor_all, lambda key, payload: heard.append((key, payload)))
        tap.subscribe(KEYS.weights, lambda key, payload: exact.append((key, payload)))
        links.settle()
        worker.publish(KEYS.monitor("worker/w0"), b"1", droppable=True)
        links.learner.publish(KEYS.monitor("learner"), b"2", droppable=True)
        links.learner.publish(KEYS.weights, b"3", droppable=False)
        links.learner.publish(KEYS.weights_latest, b"4", droppable=False)
        eventually(lambda: len(heard) == 2 and len(exact) == 1)
        assert sorted(heard) == [(KEYS.monitor("learner"), b"2"), (KEYS.monitor("worker/w0"), b"1")]
        assert exact == [(KEYS.weights, b"3")]

    def test_a_publisher_knows_whether_anybody_listens(self, links: Links) -> None:
        belief, other = KEYS.monitor("belief/w0"), KEYS.monitor("belief/w1")
        tap, worker = links.worker(), links.worker()
        tap.subscribe(KEYS.monitor("trajectories/w0"), lambda key, payload: None)
        links.settle()
        assert not worker.has_subscribers(belief)
        links.settle()
        assert not worker.has_subscribers(belief), "what others listen to is not this"
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
        heard: list[int] = []
        worker = links.worker()

        def slow(key: str, payload: bytes) -> None:
            time.sleep(0.0005)
            heard.append(int(payload))

        worker.subscribe(KEYS.weights, slow)
        links.settle()
        for i in range(1500):
            links.learner.publish(KEYS.weights, b"%d" % i, droppable=False)
        eventually(lambda: len(heard) == 1500, 60.0)
        assert heard == list(range(1500))

    def test_a_sleeping_monitor_keeps_only_so_much_whatever_the_sender_says(self, links: Links) -> None:
        tap, stranger, woken, heard = links.worker(), links.worker(), threading.Event(), list[int]()
        tap.subscribe(KEYS.monitor_all, lambda key, payload: woken.wait(60) and heard.append(len(payload)))
        arrived = threading.Event()
        tap.subscribe(KEYS.weights, lambda key, payload: arrived.set())
        links.settle()
        for _ in range(1500):
            stranger.publish(KEYS.monitor("event"), b"x", droppable=False)
        stranger.publish(KEYS.weights, b"", droppable=False)  # behind the others, on the same way
        assert arrived.wait(30)
        woken.set()
        eventually(lambda: len(heard) > 1000)
        time.sleep(0.1)
        assert len(heard) <= 1025

    def test_a_sleeping_monitor_slows_nobody(self, links: Links) -> None:
        tap, worker, woken = links.worker(), links.worker(), threading.Event()
        tap.subscribe(KEYS.monitor_all, lambda key, payload: woken.wait(60) and None)
        links.learner.subscribe(KEYS.monitor_all, lambda key, payload: woken.wait(60) and None)
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
        woken.set()

    def test_workers_are_seen_to_come_and_go(self, links: Links) -> None:
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

    def test_closing_twice_is_fine_and_ends_what_is_under_way(self, links: Links) -> None:
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
        held[0].reply(b"nobody hears this")
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

    def test_never_more_than_the_credits_are_outstanding(self, links: Links) -> None:
        held: list[Query] = []
        links.learner.serve(KEYS.data, each(held.append))
        worker = links.worker()
        links.settle()
        sender = CreditSender(worker, KEYS.data, credits=3, timeout_s=10.0)
        feeder = threading.Thread(target=lambda: list(map(sender.send, [b"%d" % i for i in range(10)])))
        feeder.start()
        for answered in range(10):
            eventually(lambda n=answered: len(held) > n)
            eventually(lambda n=answered: sender.sent == min(10, sender.acknowledged + 3) or len(held) > n + 1)
            time.sleep(0.02)
            assert len(held) <= answered + 3 and sender.outstanding <= 3
            held[answered].reply(b"stored")
        feeder.join()
        assert [query.payload for query in held] == [b"%d" % i for i in range(10)]
        sender.drain(5.0)
        assert (sender.sent, sender.resent, sender.acknowledged, sender.outstanding) == (10, 0, 10, 0)
        sender.close()

    def test_busy_and_absence_are_met_by_sending_again(self, links: Links) -> None:
        worker, events = links.worker(), list[tuple[str, str]]()
        sender = CreditSender(worker, KEYS.data, 4, 5.0, on_event=lambda *event: events.append(event))
        sender.send(b"before anyone serves")
        eventually(lambda: sender.resent)
        server = Server(lambda payload, times: "busy" if times < 2 else "")
        links.learner.serve(KEYS.data, each(server))
        sender.send(b"another")
        sender.drain(10.0)
        sender.close()
        assert sorted(server.committed) == [b"another", b"before anyone serves"]
        assert sender.resent >= 5 and sender.acknowledged == 2
        assert ("resent", "busy: full") in events

    def test_a_final_refusal_surfaces_once(self, links: Links) -> None:
        links.learner.serve(KEYS.data, each(lambda q: q.refuse("dtype: no") if q.payload == b"bad" else q.reply(b"stored")))
        worker = links.worker()
        links.settle()
        sender = CreditSender(worker, KEYS.data, 1, 5.0)
        sender.send(b"bad")
        with pytest.raises(Refused) as caught:
            sender.send(b"never taken")
        assert caught.value.reason == "dtype: no"
        sender.send(b"good")
        sender.drain(5.0)
        sender.send(b"bad")
        with pytest.raises(Refused):
            sender.drain(5.0)
        assert (sender.acknowledged, sender.outstanding) == (1, 0)
        sender.close()

    def test_draining_gives_up_at_its_timeout_and_closing_at_once(self, links: Links) -> None:
        held: list[Query] = []
        links.learner.serve(KEYS.data, held.append)
        worker = links.worker()
        links.settle()
        sender = CreditSender(worker, KEYS.data, 2, 30.0)
        sender.send(b"1")
        sender.send(b"2")
        before = sender.waited_s
        with pytest.raises(Unanswered, match="2 items"):
            sender.drain(0.1)
        drained = sender.waited_s
        assert drained - before >= 0.1
        seen: list[float] = []

        def close() -> None:
            eventually(lambda: sender.waited_s > drained)  # the wait has begun
            seen.append(sender.waited_s)
            sender.close()

        threading.Timer(0.1, close).start()
        with pytest.raises(LinkError, match="closed"):
            sender.send(b"3")
        assert drained < seen[0] < sender.waited_s == sender.waited_s, "the wait that is on counts, one that is over is over"
        sender.close()

    def test_nothing_is_lost_nor_committed_twice_when_answers_are(self, links: Links) -> None:
        rng = np.random.default_rng(0)
        fates = ["lose", "commit, lose", *[""] * 5]
        server = Server(lambda payload, times: fates[rng.integers(len(fates))])
        links.learner.serve(KEYS.data, each(server))
        worker = links.worker()
        links.settle()
        sender = CreditSender(worker, KEYS.data, 4, timeout_s=0.1)
        items = [b"%d" % i for i in range(100)]
        for item in items:
            sender.send(item)
        sender.drain(20.0)
        sender.close()
        assert sorted(server.committed) == sorted(items)
        assert server.duplicates > 0 and sender.acknowledged == 100 and sender.resent >= server.duplicates
