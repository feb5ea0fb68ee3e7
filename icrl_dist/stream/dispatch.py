"""What both links run handlers on: threads that never hold up whoever hands them work."""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from icrl_dist.stream.link import Query

_log = logging.getLogger(__name__)


class Dispatcher:
    """One thread that runs actions in order, now or after a delay; an action that raises is logged."""

    def __init__(self, name: str) -> None:
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, action: Callable[[], None], delay_s: float = 0.0) -> None:
        """Run ``action`` after ``delay_s`` seconds; once closed, never."""
        with self._changed:
            heapq.heappush(self._due, (time.monotonic() + delay_s, next(self._order), action))
            self._changed.notify()

    def close(self) -> None:
        """Run what is already due, forget the rest, and wait a second at most for that."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(1.0)

    def _run(self) -> None:
        while (action := self._next()) is not None:
            try:
                action()
            except Exception:
                _log.exception("a callback failed")

    def _next(self) -> Callable[[], None] | None:
        with self._changed:
            while True:
                wait = self._due[0][0] - time.monotonic() if self._due else None
                if wait is not None and wait <= 0:
                    return heapq.heappop(self._due)[2]
                if self._closed:
                    return None
                self._changed.wait(wait)


class Mailbox:
    """What a subscriber has not read yet, and the thread on which its handler reads it.

    Droppable messages beyond ``capacity``, or ``room`` bytes, are dropped and counted, others
    always kept, so whoever puts a message in never waits.
    """

    def __init__(self, handler: Callable[..., None], capacity: int = 1024, room: int = 32 << 20) -> None:
        self.dropped = 0
        self._handler, self._capacity, self._room = handler, capacity, room
        self._lock, self._bytes = threading.Lock(), 0
        self._waiting: deque[tuple[object, ...]] = deque()
        self._dispatcher = Dispatcher("subscriber")
        self._called = self._closed = False

    def put(self, *message: object, droppable: bool) -> None:
        """Leave a message, never waiting."""
        size = _bytes_in(message)
        with self._lock:
            if droppable and (len(self._waiting) >= self._capacity or self._bytes + size > self._room):
                self.dropped += 1
                return
            self._bytes += size
        self._waiting.append(message)
        if not self._called:  # else it is being read, or about to be
            self._called = True
            self._dispatcher.post(self._read)

    def close(self) -> None:
        """Forget what is unread; wait a second at most for the handler to return."""
        self._closed = True
        self._dispatcher.close()

    def _read(self) -> None:
        self._called = False  # before looking: whoever puts a message in from now on calls again
        while self._waiting and not self._closed:
            message = self._waiting.popleft()
            with self._lock:
                self._bytes -= _bytes_in(message)
            try:
                self._handler(*message)
            except Exception:
                _log.exception("a subscriber's handler failed")


def _bytes_in(message: tuple[object, ...]) -> int:
    return sum(len(part) for part in message if isinstance(part, bytes))


def handle(handler: Callable[[Query], None], query: Query) -> None:
    """Run a server's handler; what it raises is logged and becomes the answer."""
    try:
        handler(query)
    except Exception as error:
        _log.exception("the handler of %s failed", query.key)
        try:
            query.refuse(f"error: {type(error).__name__}: {error}")
        except RuntimeError:
            _log.warning("%s had been answered before its handler failed", query.key)
