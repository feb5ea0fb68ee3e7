"""The threads on which both links run handlers, so that callers never wait for a handler."""

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
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._order = itertools.count()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, action: Callable[[], object], delay_s: float = 0.0) -> None:
        """Run ``action`` after ``delay_s`` seconds; after ``close`` do nothing."""
        with self._changed:
            heapq.heappush(self._due, (time.monotonic() + delay_s, next(self._order), action))
            self._changed.notify()

    def close(self) -> None:
        """Run the actions that are due, discard the others, and wait at most a second for the thread to end."""
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

    def _next(self) -> Callable[[], object] | None:
        with self._changed:
            while True:
                wait = self._due[0][0] - time.monotonic() if self._due else None
                if wait is not None and wait <= 0:
                    return heapq.heappop(self._due)[2]
                if self._closed:
                    return None
                self._changed.wait(wait)


class Mailbox:
    """The queue of a subscriber's unread messages, and the thread that calls its handler.

    ``put`` never waits: beyond ``capacity`` messages or ``max_bytes`` bytes, droppable messages are
    dropped and counted.  Other messages are always kept.
    """

    def __init__(self, handler: Callable[..., None], capacity: int = 1024, max_bytes: int = 32 << 20) -> None:
        self.dropped = 0
        self._handler, self._capacity, self._max_bytes = handler, capacity, max_bytes
        self._lock, self._bytes = threading.Lock(), 0
        self._unread: deque[tuple[object, ...]] = deque()
        self._dispatcher = Dispatcher("subscriber")
        self._posted = self._closed = False

    def put(self, *message: object, droppable: bool) -> None:
        """Add a message, without waiting."""
        size = _bytes_in(message)
        with self._lock:
            if droppable and (len(self._unread) >= self._capacity or self._bytes + size > self._max_bytes):
                self.dropped += 1
                return
            self._bytes += size
        self._unread.append(message)
        if not self._posted:  # else a call of _read is due and will find the message
            self._posted = True
            self._dispatcher.post(self._read)

    def close(self) -> None:
        """Discard unread messages; wait at most a second for the handler to return."""
        self._closed = True
        self._dispatcher.close()

    def _read(self) -> None:
        self._posted = False  # before reading, so that a later put posts another call
        while self._unread and not self._closed:
            message = self._unread.popleft()
            with self._lock:
                self._bytes -= _bytes_in(message)
            try:
                self._handler(*message)
            except Exception:
                _log.exception("a subscriber's handler failed")


def _bytes_in(message: tuple[object, ...]) -> int:
    return sum(len(part) for part in message if isinstance(part, bytes))


def handle(handler: Callable[[Query], None], query: Query) -> None:
    """Run a server's handler; an error that it raises is logged and becomes the answer."""
    try:
        handler(query)
    except Exception as error:
        _log.exception("the handler of %s failed", query.key)
        try:
            query.refuse(f"error: {type(error).__name__}: {error}")
        except RuntimeError:
            _log.warning("%s was answered before its handler failed", query.key)
