"""Sending without losing: at most so many items unanswered, each kept until its answer."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from icrl_dist.stream.link import Link, LinkError, Outcome, Refused, Unanswered
from icrl_dist.stream.threads import Dispatcher

BACKOFF_S = (0.05, 2.0)
"""First and longest wait before an item is sent again, seconds; each wait doubles the last."""


class CreditSender:
    """Sends items to ``key`` until each is acknowledged, never more than ``credits`` at once.

    Unanswered items, and those refused as ``busy``, are sent again for as long as it takes; the
    other side drops duplicates.  Any other refusal is final: the item is given up and the next
    ``send`` or ``drain`` raises Refused.  ``on_event`` hears ``resent`` and ``refused``, with why,
    and must not block.
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
        self._outstanding = 0
        self._failure: Refused | LinkError | None = None
        self._closed = False
        self._resends = Dispatcher("resends")

    @property
    def outstanding(self) -> int:
        """Items taken in and neither acknowledged nor refused."""
        return self._outstanding

    def send(self, payload: bytes) -> None:
        """Take an item, waiting for a credit.  Raises Refused for an earlier item, LinkError if closed."""
        self._credit.get()
        with self._changed:
            try:
                self._raise()
            except BaseException:
                self._credit.put(None)
                raise
            self._outstanding += 1
            self.sent += 1
        self._attempt(payload, 0)

    def drain(self, timeout_s: float) -> None:
        """Wait until every item is acknowledged.  Raises Refused for one that was not, Unanswered after ``timeout_s``."""
        with self._changed:
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
        self._resends.close()

    def _raise(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        if self._closed:
            raise LinkError(f"the sender on {self._key} is closed, {self._outstanding} items were unanswered")

    def _attempt(self, payload: bytes, resends: int) -> None:
        if self._closed:
            return
        try:
            self._link.send(self._key, payload, self._timeout_s, lambda outcome: self._settle(payload, resends, outcome))
        except LinkError as error:
            self._give_up(error)

    def _settle(self, payload: bytes, resends: int, outcome: Outcome) -> None:
        if isinstance(outcome, bytes):
            with self._changed:
                self.acknowledged += 1
                self._release()
        elif isinstance(outcome, Unanswered) or outcome.reason.startswith("busy"):
            with self._changed:
                self.resent += 1
            first, longest = BACKOFF_S
            self._resends.post(lambda: self._attempt(payload, resends + 1), min(longest, first * 2 ** min(resends, 16)))
            self._tell("resent", str(outcome))
        else:
            self._give_up(outcome)
            self._tell("refused", outcome.reason)

    def _give_up(self, failure: Refused | LinkError) -> None:
        with self._changed:
            self._failure = self._failure or failure
            self._release()

    def _release(self) -> None:
        self._outstanding -= 1
        self._credit.put(None)
        if self._failure or not self._outstanding:
            self._changed.notify_all()

    def _tell(self, event: str, reason: str) -> None:
        if self._on_event is not None:
            self._on_event(event, reason)
