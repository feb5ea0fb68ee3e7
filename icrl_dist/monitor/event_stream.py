"""Server-sent events from any thread to many viewers; a slow viewer delays neither the publisher nor another viewer."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable

from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

MAX_VIEWERS = 64
"""Viewers of one page at once; further ones are refused."""
MAX_QUEUED = 256
"""Events that wait for one viewer; the oldest are dropped for a slower viewer."""
MAX_BEHIND = 16
"""Events that wait for one viewer in an incremental stream; a slower viewer restarts from the initial event."""
_PING_S = 10
"""A viewer receives a comment this often, so that a broken connection is noticed."""
_SEPARATOR = "\n"
_RETRY = ServerSentEvent(retry=1000, sep=_SEPARATOR).encode()
"""A browser reconnects after a second."""


class EventStream:
    """Publishes events from any thread to any number of viewers.

    A *state* event replaces an unsent event of the same name, and a new viewer receives the
    newest state events first.  Any other event is sent once, or dropped if the viewer is slow.

    In an incremental stream each event is a change since the event before it.  Such a stream has
    an ``initial_event``: a function, called on a thread of the server after the viewer has been
    added, that returns the name and JSON text of the event to start from.  A viewer that fell
    behind starts from it again.
    """

    def __init__(self, initial_event: Callable[[], tuple[str, str]] | None = None) -> None:
        self._initial_event = initial_event
        self._lock = threading.Lock()
        self._viewers: set[_Viewer] = set()
        self._state: dict[str, bytes] = {}
        self._closed = False

    def publish(self, event: str, data: object, state: bool = False) -> None:
        """Send ``data`` to every viewer as JSON.  Raises ValueError for values that JSON does not have (NaN)."""
        encoded = _encoded(event, json.dumps(data, allow_nan=False, separators=(",", ":")))  # once for all viewers
        with self._lock:
            if state:
                self._state[event] = encoded
            for viewer in self._viewers:
                viewer.put(event, encoded, state)

    @property
    def viewers(self) -> int:
        """Number of connected viewers."""
        return len(self._viewers)

    def close(self) -> None:
        """End the stream of every viewer and accept no more."""
        with self._lock:
            self._closed = True
            for viewer in self._viewers:
                viewer.end()

    async def _events(self) -> AsyncIterator[bytes]:
        viewer = _Viewer(asyncio.get_running_loop(), self._initial_event)
        with self._lock:
            if len(self._viewers) >= MAX_VIEWERS:  # several requests passed the check in ``respond`` at the same time
                return
            for event, encoded in self._state.items():
                viewer.put(event, encoded, True)
            self._viewers.add(viewer)
            if self._closed:
                viewer.end()
        try:
            yield _RETRY
            while (chunk := await viewer.next()) is not None:
                yield chunk
        finally:
            with self._lock:
                self._viewers.discard(viewer)

    async def respond(self, request: Request) -> Response:
        """The endpoint: server-sent events until the viewer disconnects or the stream is closed."""
        if len(self._viewers) >= MAX_VIEWERS:
            return PlainTextResponse(f"{len(self._viewers)} viewers are connected, the limit: close one and reload", 503)
        return EventSourceResponse(self._events(), ping=_PING_S, ping_message_factory=_ping, sep=_SEPARATOR)


class _Viewer:
    """The events that wait for one viewer."""

    def __init__(self, loop: asyncio.AbstractEventLoop, initial_event: Callable[[], tuple[str, str]] | None = None) -> None:
        self._loop, self._lock, self._ready = loop, threading.Lock(), asyncio.Event()
        self._queue: deque[tuple[str, bytes, bool]] = deque()
        self._ended = False
        self._initial_event, self._needs_initial = initial_event, initial_event is not None

    def put(self, event: str, encoded: bytes, state: bool) -> None:
        """Queue an event; called from any thread."""
        with self._lock:
            if state:
                self._queue = deque(one for one in self._queue if not (one[2] and one[0] == event))
            self._queue.append((event, encoded, state))
            if self._initial_event is not None and len(self._queue) > MAX_BEHIND:
                self._queue.clear()
                self._needs_initial = True
            while len(self._queue) > MAX_QUEUED:
                oldest = next((i for i, one in enumerate(self._queue) if not one[2]), 0)
                del self._queue[oldest]
        self._wake()

    def end(self) -> None:
        self._ended = True
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the viewer has disconnected
            self._loop.call_soon_threadsafe(self._ready.set)

    async def next(self) -> bytes | None:
        """All waiting events, encoded, as soon as there is one; None at the end."""
        while not self._ended:
            with self._lock:
                if restart := self._needs_initial:
                    self._needs_initial = False  # before the call below: events queued from now on follow the initial event
                else:
                    waiting, self._queue = self._queue, deque()
            if restart:
                assert self._initial_event is not None
                return _encoded(*await asyncio.to_thread(self._initial_event))
            if waiting:
                return b"".join(encoded for _, encoded, _ in waiting)
            await self._ready.wait()
            self._ready.clear()
        return None


def _encoded(event: str, data: str) -> bytes:
    return ServerSentEvent(data, event=event, sep=_SEPARATOR).encode()


def _ping() -> ServerSentEvent:
    return ServerSentEvent(comment="ping", sep=_SEPARATOR)
