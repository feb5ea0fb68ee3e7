"""The seam between this project and a network: key names, and what a link between processes does.

:class:`MemoryLink` does it within one process, ``zenoh_link.ZenohLink`` between machines; one
battery of tests runs over both.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one run.  Raises ValueError for a name that cannot be part of a key."""

    run: str

    def __post_init__(self) -> None:
        _part(self.run)

    @property
    def data(self) -> str:
        """Trajectories in, answered when they are stored."""
        return f"icrl/{self.run}/data"

    @property
    def work(self) -> str:
        """Work out, asked for by idle workers."""
        return f"icrl/{self.run}/work"

    @property
    def weights(self) -> str:
        """Every new version of the weights, published."""
        return f"icrl/{self.run}/weights"

    @property
    def weights_latest(self) -> str:
        """The newest version of the weights, for those who ask."""
        return f"icrl/{self.run}/weights/latest"

    @property
    def monitor_all(self) -> str:
        """Everything on the monitor plane."""
        return f"icrl/{self.run}/mon/**"

    @property
    def alive_all(self) -> str:
        """The liveliness of every worker."""
        return f"icrl/{self.run}/alive/*"

    def monitor(self, topic: str) -> str:
        """One topic of the monitor plane, such as ``trajectory/w0``."""
        for part in topic.split("/"):
            _part(part)
        return f"icrl/{self.run}/mon/{topic}"

    def alive(self, worker: str) -> str:
        """The liveliness of one worker."""
        return f"icrl/{self.run}/alive/{_part(worker)}"


def _part(name: str) -> str:
    if not name or any(c in "/*$?#" or not c.isprintable() for c in name):
        raise ValueError(f"{name!r} cannot be part of a key: it must not be empty nor hold any of / * $ ? #")
    return name


class LinkError(OSError):
    """A link that cannot be opened, or is closed; says which and what to do."""


class Refused(Exception):  # noqa: N818
    """The other side answered, with a reason for not doing what was asked."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Unanswered(Exception):  # noqa: N818
    """No answer: nobody there, nobody quick enough, or the link broke on the way."""


Outcome = bytes | Refused | Unanswered
Done = Callable[[Outcome], None]


class Query(Protocol):
    """A request as its server sees it; to be answered once, from any thread, now or later.

    An answer that cannot reach the other side any more is lost, as on any network: the
    request ends Unanswered there.  A second answer raises RuntimeError.
    """

    @property
    def key(self) -> str: ...

    @property
    def payload(self) -> bytes: ...

    def reply(self, payload: bytes) -> None: ...

    def refuse(self, reason: str) -> None: ...


class Link(Protocol):
    """One process's end of the streams.  Using a closed link raises LinkError."""

    def request(self, key: str, payload: bytes, timeout_s: float) -> bytes:
        """Ask and wait.  Raises Refused or Unanswered; never call it from a handler."""
        answers: queue.SimpleQueue[Outcome] = queue.SimpleQueue()
        self.send(key, payload, timeout_s, answers.put)
        outcome = answers.get()
        if isinstance(outcome, bytes):
            return outcome
        raise outcome

    def send(self, key: str, payload: bytes, timeout_s: float, done: Done) -> None:
        """Ask without waiting; ``done`` is called once, from another thread, and must not block."""

    def serve(self, key: str, handler: Callable[[Query], None]) -> None:
        """Answer requests for ``key``.  The handler must not block; if it raises, the error is the answer."""

    def publish(self, key: str, payload: bytes, droppable: bool) -> None:
        """Tell whoever subscribes.  What is droppable is dropped sooner than it makes anyone wait."""

    def subscribe(self, key_expr: str, handler: Callable[[str, bytes], None]) -> None:
        """Hear, on a thread of its own, what is published under ``key_expr`` (``*`` one part, ``**`` any).

        A handler that falls behind misses droppable messages; it slows nobody down.
        """

    def announce(self, key: str) -> None:
        """Be seen alive under ``key`` until this link closes or its process dies."""

    def watch(self, key_expr: str, handler: Callable[[str, bool], None]) -> None:
        """Hear the last part of each key that comes alive (True, at once if it is) or goes (False)."""

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where other links can connect to."""

    def close(self) -> None:
        """Let go of everything; requests under way end Unanswered.  Closing twice is fine."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def matches(key_expr: str, key: str) -> bool:
    """Whether a key expression covers a key: ``*`` stands for one part, ``**`` for any number."""
    return _covers(key_expr.split("/"), key.split("/"))


def _covers(expr: list[str], key: list[str]) -> bool:
    if not expr:
        return not key
    if expr[0] == "**":
        return any(_covers(expr[1:], key[i:]) for i in range(len(key) + 1))
    return bool(key) and expr[0] in ("*", key[0]) and _covers(expr[1:], key[1:])


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

    Droppable messages beyond ``capacity`` are dropped and counted, others always kept, so
    whoever puts a message in never waits.
    """

    def __init__(self, handler: Callable[..., None], capacity: int = 1024) -> None:
        self.dropped = 0
        self._handler, self._capacity = handler, capacity
        self._waiting: deque[tuple[object, ...]] = deque()
        self._dispatcher = Dispatcher("subscriber")
        self._closed = False

    def put(self, *message: object, droppable: bool) -> None:
        """Leave a message, never waiting."""
        if droppable and len(self._waiting) >= self._capacity:
            self.dropped += 1
            return
        self._waiting.append(message)
        self._dispatcher.post(self._read)

    def close(self) -> None:
        """Forget what is unread; wait a second at most for the handler to return."""
        self._closed = True
        self._dispatcher.close()

    def _read(self) -> None:
        message = self._waiting.popleft()
        if not self._closed:
            self._handler(*message)


class MemoryHub:
    """The network within one process: every link of a hub reaches every other."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._links: list[MemoryLink] = []
        self._dispatcher: Dispatcher | None = None
        self._under_way: set[_MemoryQuery] = set()
        self._expiring = False

    def link(self) -> MemoryLink:
        """Another link to this hub."""
        made = MemoryLink(self)
        with self._lock:
            self._links.append(made)
            self._dispatcher = self._dispatcher or Dispatcher("memory-hub")
        return made

    def _expire_soon(self) -> None:
        if self._under_way and not self._expiring and self._dispatcher is not None:
            self._expiring = True
            self._dispatcher.post(self._expire, 0.02)

    def _expire(self) -> None:
        now = time.monotonic()
        with self._lock:
            late = [query for query in self._under_way if query.deadline <= now]
        for query in late:
            query.end(Unanswered(f"no answer on {query.key} in time"))
        with self._lock:
            self._expiring = False
            self._expire_soon()


class MemoryLink(Link):
    """A link to a :class:`MemoryHub`: for tests, debugging and ``--engine inline``.

    Handlers of requests and ``done`` run on the hub's one thread.
    """

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self._servers: dict[str, Callable[[Query], None]] = {}
        self._mailboxes: list[tuple[str, Mailbox]] = []
        self._watchers: list[tuple[str, Mailbox]] = []
        self._alive: set[str] = set()
        self._closed = False

    def send(self, key: str, payload: bytes, timeout_s: float, done: Done) -> None:
        with self._hub._lock:
            dispatcher = self._dispatcher()
            found = [(link, link._servers[key]) for link in self._hub._links if key in link._servers]
            if not found:
                dispatcher.post(lambda: done(Unanswered(f"nobody serves {key}")))
                return
            server, handler = found[0]
            query = _MemoryQuery(self, server, key, payload, done, time.monotonic() + timeout_s)
            self._hub._under_way.add(query)
            dispatcher.post(lambda: handle(handler, query))
            self._hub._expire_soon()

    def serve(self, key: str, handler: Callable[[Query], None]) -> None:
        with self._hub._lock:
            self._dispatcher()
            self._servers[key] = handler

    def publish(self, key: str, payload: bytes, droppable: bool) -> None:
        with self._hub._lock:
            self._dispatcher()
            for link in self._hub._links:
                for expr, mailbox in link._mailboxes:
                    if matches(expr, key):
                        mailbox.put(key, payload, droppable=droppable)

    def subscribe(self, key_expr: str, handler: Callable[[str, bytes], None]) -> None:
        with self._hub._lock:
            self._dispatcher()
            self._mailboxes.append((key_expr, Mailbox(handler)))

    def announce(self, key: str) -> None:
        with self._hub._lock:
            self._dispatcher()
            self._alive.add(key)
            self._tell(key, True)

    def watch(self, key_expr: str, handler: Callable[[str, bool], None]) -> None:
        with self._hub._lock:
            self._dispatcher()
            mailbox = Mailbox(handler)
            self._watchers.append((key_expr, mailbox))
            for link in self._hub._links:
                for key in link._alive:
                    if matches(key_expr, key):
                        mailbox.put(key.rpartition("/")[2], True, droppable=False)

    @property
    def endpoints(self) -> tuple[str, ...]:
        return ()

    def close(self) -> None:
        hub, last = self._hub, None
        with hub._lock:
            if self._closed:
                return
            self._closed = True
            hub._links.remove(self)
            for key in self._alive:
                self._tell(key, False)
            cut = [query for query in hub._under_way if self in (query.asker, query.server)]
            if hub._dispatcher is not None:
                for query in cut:
                    hub._dispatcher.post(lambda query=query: query.end(Unanswered("the link was closed")))  # type: ignore[misc]
            if not hub._links:
                last, hub._dispatcher, hub._expiring = hub._dispatcher, None, False
        for _, mailbox in self._mailboxes + self._watchers:
            mailbox.close()
        if last is not None:
            last.close()

    def _dispatcher(self) -> Dispatcher:
        if self._closed or self._hub._dispatcher is None:
            raise LinkError("this link is closed: open another")
        return self._hub._dispatcher

    def _tell(self, key: str, alive: bool) -> None:
        for link in self._hub._links:
            for expr, mailbox in link._watchers:
                if matches(expr, key):
                    mailbox.put(key.rpartition("/")[2], alive, droppable=False)


class _MemoryQuery:
    def __init__(self, asker: MemoryLink, server: MemoryLink, key: str, payload: bytes, done: Done, deadline: float) -> None:
        self.asker, self.server = asker, server
        self.key, self.payload, self.deadline = key, payload, deadline
        self._done = done
        self._answered = False

    def reply(self, payload: bytes) -> None:
        self._answer(bytes(payload))

    def refuse(self, reason: str) -> None:
        self._answer(Refused(reason))

    def end(self, outcome: Outcome) -> None:
        """Tell the asker, on the hub's thread; of all outcomes the first one counts."""
        with self.asker._hub._lock:
            if self not in self.asker._hub._under_way:
                return
            self.asker._hub._under_way.remove(self)
        self._done(outcome)

    def _answer(self, outcome: Outcome) -> None:
        with self.asker._hub._lock:
            if self._answered:
                raise RuntimeError(f"this query on {self.key} has been answered already")
            self._answered = True
            dispatcher = self.asker._hub._dispatcher
            if dispatcher is not None:
                dispatcher.post(lambda: self.end(outcome))


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
