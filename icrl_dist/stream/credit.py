"""Sending without loss: a bounded number of items is unanswered, and each is kept until it is acknowledged."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from icrl_dist.stream import batching
from icrl_dist.stream.dispatch import Dispatcher
from icrl_dist.stream.link import Link, LinkError, Outcome, Refused, Unanswered
from icrl_dist.stream.validation import WireError

BACKOFF_S = (0.05, 2.0)
"""First and longest wait before an item is sent again, seconds; the wait doubles each time."""

MAX_REQUESTS = 2
"""Requests in flight: the learner answers one while the other travels.  The first is sent at once,
so an idle link never waits; the second when half the credits are waiting."""

REQUEST_BYTES = 1 << 20
"""Items share a request up to this size; a larger item has a request of its own."""


@dataclass(slots=True)
class _Item:
    payload: bytes
    resends: int = 0


class CreditSender:
    """Sends items to ``key`` until each is acknowledged, with at most ``credits`` items unacknowledged.

    Unanswered items, and items refused as ``busy``, are sent again without a limit; the receiver
    drops duplicates.  Any other refusal is final: the item is given up, and the next ``send`` or
    ``drain`` raises Refused.  ``on_event`` is called with ``resent`` or ``refused`` and the reason;
    it must not block.  The receiver splits requests with ``batching.split``.
    """

    def __init__(
        self,
        link: Link,
        key: str,
        credits: int,
        timeout_s: float,
        on_event: Callable[[str, str], None] | None = None,
    ) -> None:
        if credits < 1:
            raise ValueError(f"credits={credits}: must be at least 1")
        self.sent = 0
        """Items accepted by ``send``."""
        self.resent = 0
        """Times that an item was sent again."""
        self.acknowledged = 0
        """Items that the receiver acknowledged."""
        self._link, self._key, self._timeout_s = link, key, timeout_s
        self._on_event = on_event
        self._changed = threading.Condition()
        self._credit: queue.SimpleQueue[None] = queue.SimpleQueue()
        for _ in range(credits):
            self._credit.put(None)
        self._waiting: deque[_Item] = deque()
        self._second_threshold = max(1, credits // MAX_REQUESTS)
        self._requests = 0
        self._outstanding = 0
        self._failure: Refused | LinkError | None = None
        self._closed = False
        self._dispatcher = Dispatcher("credit")
        self._waited: tuple[float, float | None] = (0.0, None)

    @property
    def outstanding(self) -> int:
        """Items accepted and neither acknowledged nor refused."""
        return self._outstanding

    @property
    def waited_s(self) -> float:
        """Seconds that ``send`` and ``drain`` have waited for answers so far."""
        ended, since = self._waited  # one read, because another thread may write
        return ended if since is None else ended + time.monotonic() - since

    @contextlib.contextmanager
    def _wait(self) -> Iterator[None]:
        ended, since = self._waited[0], time.monotonic()
        self._waited = ended, since
        try:
            yield
        finally:
            self._waited = ended + time.monotonic() - since, None

    def send(self, payload: bytes) -> None:
        """Accept an item, after waiting for a credit.  Raises Refused for an earlier item, LinkError if closed."""
        with self._wait():
            self._credit.get()
        with self._changed:
            try:
                self._raise()
            except BaseException:
                self._credit.put(None)
                raise
            self._outstanding += 1
            self.sent += 1
            self._waiting.append(_Item(payload))
        self._send_waiting()

    def drain(self, timeout_s: float) -> None:
        """Wait until every item is acknowledged.  Raises Refused for a refused item, Unanswered after ``timeout_s``."""
        with self._changed:
            with self._wait():
                self._changed.wait_for(lambda: self._failure or self._closed or not self._outstanding, timeout_s)
            if self._failure or self._outstanding:
                self._raise()
                raise Unanswered(f"{self._outstanding} items on {self._key} unanswered after {timeout_s:g} s")

    def close(self) -> None:
        """Give up outstanding items.  The link stays open."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._credit.put(None)
        self._dispatcher.close()

    def _raise(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        if self._closed:
            raise LinkError(f"the sender on {self._key} is closed with {self._outstanding} items unanswered: open another")

    def _send_waiting(self) -> None:
        """Send waiting items in one request, if no request is in flight or if enough wait for a second one."""
        with self._changed:
            if not self._ready():
                return
            items, size = [self._waiting.popleft()], 0
            while self._waiting and (size := size + len(items[-1].payload)) + len(self._waiting[0].payload) <= REQUEST_BYTES:
                items.append(self._waiting.popleft())
            self._requests += 1
        try:
            request = batching.join([item.payload for item in items])
            self._link.send(self._key, request, self._timeout_s, lambda outcome: self._settle(items, outcome))
        except LinkError as error:
            with self._changed:
                self._requests -= 1
                for _ in items:
                    self._give_up(error)

    def _ready(self) -> bool:
        if self._closed or not self._waiting or self._requests >= MAX_REQUESTS:
            return False
        return not self._requests or len(self._waiting) >= self._second_threshold

    def _settle(self, items: list[_Item], outcome: Outcome) -> None:
        reasons, final = _reasons(outcome, len(items))
        events: list[tuple[str, str]] = []
        with self._changed:
            self._requests -= 1
            again: list[_Item] = []
            for item, reason in zip(items, reasons, strict=True):
                if not reason:
                    self.acknowledged += 1
                    self._release()
                elif not final or reason.startswith("busy"):
                    item.resends += 1
                    self.resent += 1
                    again.append(item)
                    events.append(("resent", reason))
                else:
                    self._give_up(Refused(reason))
                    events.append(("refused", reason))
            if again:
                first, longest = BACKOFF_S
                delay = min(longest, first * 2 ** min(again[0].resends - 1, 16))
                self._dispatcher.post(lambda: self._resend(again), delay)
            if self._ready():
                # On another thread: this one may be the link's own, which must not use the link.
                self._dispatcher.post(self._send_waiting)
        if self._on_event is not None:
            for event, reason in events:
                self._on_event(event, reason)

    def _resend(self, items: list[_Item]) -> None:
        with self._changed:
            self._waiting.extendleft(reversed(items))
        self._send_waiting()

    def _give_up(self, failure: Refused | LinkError) -> None:
        self._failure = self._failure or failure
        self._release()

    def _release(self) -> None:
        self._outstanding -= 1
        self._credit.put(None)
        if self._failure or not self._outstanding:
            self._changed.notify_all()


def _reasons(outcome: Outcome, count: int) -> tuple[list[str], bool]:
    """The reason against each item, empty if it was accepted; and whether the receiver gave the reasons."""
    if isinstance(outcome, bytes):
        try:
            return batching.reasons(outcome, count), True
        except WireError as error:
            return [f"invalid answer: {error}"] * count, False
    return [str(outcome)] * count, isinstance(outcome, Refused)
