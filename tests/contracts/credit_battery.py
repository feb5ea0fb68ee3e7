"""Contract tests of CreditSender over any Link: a test class inherits them and provides the fixture ``links``."""

from __future__ import annotations

import functools
import threading
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from icrl_dist.stream import batching
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import LinkError, Query, Refused, Unanswered
from tests.contracts.link_battery import KEYS, Links, eventually


def each(handler: Callable[[Query], object]) -> Callable[[Query], None]:
    """A handler of requests that calls ``handler`` with each of their items."""

    def split(query: Query) -> None:
        for part in batching.split(query, 1 << 20):
            handler(part)

    return split


class Server:
    """Commits each payload once; ``plan(payload, times)`` decides how each request is answered."""

    def __init__(self, plan: Callable[[bytes, int], str]) -> None:
        self.committed: list[bytes] = []
        self.duplicates = 0
        self.requests: Counter[bytes] = Counter()
        self.held: list[Query] = []
        self._plan = plan

    def __call__(self, query: Query) -> None:
        payload = query.payload
        action = self._plan(payload, self.requests[payload])
        self.requests[payload] += 1
        if action == "busy":
            query.refuse("busy: full")
            return
        if action == "lose":
            self.held.append(query)
            return
        if payload in self.committed:
            self.duplicates += 1
        else:
            self.committed.append(payload)
        if action == "commit, lose":
            self.held.append(query)
        else:
            query.reply(b"stored")


class CreditBattery:
    def test_at_most_as_many_items_as_credits_are_outstanding(self, links: Links) -> None:
        held: list[Query] = []
        links.learner.serve(KEYS.data, each(held.append))
        worker = links.worker()
        links.settle()
        sender = CreditSender(worker, KEYS.data, credits=3, timeout_s=10.0)
        feeder = threading.Thread(target=lambda: list(map(sender.send, [b"%d" % i for i in range(10)])))
        feeder.start()

        def arrived(answered: int) -> bool:
            return len(held) > answered

        def replaced(answered: int) -> bool:
            return sender.sent == min(10, sender.acknowledged + 3) or len(held) > answered + 1

        for answered in range(10):
            eventually(functools.partial(arrived, answered))
            eventually(functools.partial(replaced, answered))
            time.sleep(0.02)
            assert len(held) <= answered + 3 and sender.outstanding <= 3
            held[answered].reply(b"stored")
        feeder.join()
        assert [query.payload for query in held] == [b"%d" % i for i in range(10)]
        sender.drain(5.0)
        assert (sender.sent, sender.resent, sender.acknowledged, sender.outstanding) == (10, 0, 10, 0)
        sender.close()

    def test_items_are_sent_again_while_the_receiver_is_busy_or_absent(self, links: Links) -> None:
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

    def test_a_final_refusal_is_raised_once(self, links: Links) -> None:
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

    def test_drain_ends_at_its_timeout_and_close_ends_send_at_once(self, links: Links) -> None:
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
            eventually(lambda: sender.waited_s > drained)  # send is waiting
            seen.append(sender.waited_s)
            sender.close()

        threading.Timer(0.1, close).start()
        with pytest.raises(LinkError, match="closed"):
            sender.send(b"3")
        assert drained < seen[0] < sender.waited_s == sender.waited_s, "a wait counts while it lasts and not afterwards"
        sender.close()

    def test_lost_answers_lose_no_item_and_commit_none_twice(self, links: Links) -> None:
        rng = np.random.default_rng(0)
        actions = ["lose", "commit, lose", *[""] * 5]
        server = Server(lambda payload, times: actions[rng.integers(len(actions))])
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
