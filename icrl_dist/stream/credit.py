"""Sending without losing: at most so many items unanswered, each kept until its answer."""

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
"""First and longest wait before an item is sent again, seconds; each wait doubles the last."""

FLIGHTS = 2
"""Requests under way: one is answered while the other travels.  The second leaves when half
the credits wait, the first at once, so nothing is kept back from an idle link."""

TOGETHER_BYTES = 1 << 20
"""Items travel together up to so many bytes; a larger one travels alone."""


@dataclass(slots=True)
class _Item:
    payload: bytes
    resends: int = 0


class CreditSender:
    """Sends items to ``key`` until each is acknowledged, never more than ``credits`` at once.

    Unanswered items, and those refused as ``busy``, are sent again for as long as it takes; the
    other side drops duplicates.  Any other refusal is final: the item is given up and the next
    ``send`` or ``drain`` raises Refused.  ``on_event`` hears ``resent`` and ``refused``, with why,
    and must not block.  The other side takes requests apart with ``batch.split``.
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
            raise ValueError(f"credits={credits}: at least one item must be allowed under way")
        self.sent = 0
        """Items taken in."""
        self.resent = 0
        """Times that an item was sent again."""
        self.acknowledged = 0
        """Items answered positively."""
        self._link, self._key, self._timeout_s = link, key, timeout_s
        self._on_event = on_event
        self._changed = threading.Condition()
        self._credit: queue.SimpleQueue[None] = queue.SimpleQueue()
        for _ in range(credits):
            self._credit.put(None)
        self._waiting: deque[_Item] = deque()
        self._enough = max(1, credits // FLIGHTS)
        self._flights = 0
        self._outstanding = 0
        self._failure: Refused | LinkError | None = None
        self._closed = False
        self._dispatcher = Dispatcher("credit")
        self._waited: tuple[float, float | None] = (0.0, None)

    @property
    def outstanding(self) -> int:
        """Items taken in and neither acknowledged nor refused."""
        return self._outstanding

    @property
    def waited_s(self) -> float:
        """Seconds that ``send`` and ``drain`` have waited for answers, until now."""
        ended, since = self._waited  # one value: another thread may ask
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
        """Take an item, waiting for a credit.  Raises Refused for an earlier item, LinkError if closed."""
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
        self._fly()

    def drain(self, timeout_s: float) -> None:
        """Wait until every item is acknowledged.  Raises Refused for one that was not, Unanswered after ``timeout_s``."""
        with self._changed:
            with self._wait():
                self._changed.wait_for(lambda: self._failure or self._closed or not self._outstanding, timeout_s)
            if self._failure or self._outstanding:
                self._raise()
                raise Unanswered(f"{self._outstanding} items on {self._key} unanswered after {timeout_s:g} s")

    def close(self) -> None:
        """Give up what is outstanding.  The link stays open."""
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
            raise LinkError(f"the sender on {self._key} is closed, {self._outstanding} items were unanswered")

    def _fly(self) -> None:
        """Send what waits, together, if the link is idle or there is enough to be worth a second request."""
        with self._changed:
            if not self._ready():
                return
            items, size = [self._waiting.popleft()], 0
            while self._waiting and (size := size + len(items[-1].payload)) + len(self._waiting[0].payload) <= TOGETHER_BYTES:
                items.append(self._waiting.popleft())
            self._flights += 1
        try:
            request = batching.join([item.payload for item in items])
            self._link.send(self._key, request, self._timeout_s, lambda outcome: self._land(items, outcome))
        except LinkError as error:
            with self._changed:
                self._flights -= 1
                for _ in items:
                    self._give_up(error)

    def _ready(self) -> bool:
        if self._closed or not self._waiting or self._flights >= FLIGHTS:
            return False
        return not self._flights or len(self._waiting) >= self._enough

    def _land(self, items: list[_Item], outcome: Outcome) -> None:
        reasons, final = _reasons(outcome, len(items))
        events: list[tuple[str, str]] = []
        with self._changed:
            self._flights -= 1
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
                self._dispatcher.post(lambda: self._again(again), delay)
            if self._ready():
                # Not from here: this may be the link's own thread, which must not use the link.
                self._dispatcher.post(self._fly)
        if self._on_event is not None:
            for event, reason in events:
                self._on_event(event, reason)

    def _again(self, items: list[_Item]) -> None:
        with self._changed:
            self._waiting.extendleft(reversed(items))
        self._fly()

    def _give_up(self, failure: Refused | LinkError) -> None:
        self._failure = self._failure or failure
        self._release()

    def _release(self) -> None:
        self._outstanding -= 1
        self._credit.put(None)
        if self._failure or not self._outstanding:
            self._changed.notify_all()


def _reasons(outcome: Outcome, count: int) -> tuple[list[str], bool]:
    """Why each item was not taken, empty where it was; and whether a reason is the other side's own."""
    if isinstance(outcome, bytes):
        try:
            return batching.reasons(outcome, count), True
        except WireError as error:
            return [f"an answer that is none: {error}"] * count, False
    return [str(outcome)] * count, isinstance(outcome, Refused)
