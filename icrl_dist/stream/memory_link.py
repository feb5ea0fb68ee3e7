"""Links within one process, with the behavior of links between nodes, timeouts included."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from icrl_dist.stream.dispatch import Dispatcher, Mailbox, handle
from icrl_dist.stream.link import Done, Link, LinkError, Outcome, Query, Refused, Unanswered, matches, may_drop


class MemoryHub:
    """A network within one process: every link of a hub is connected to every other."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._links: list[MemoryLink] = []
        self._dispatcher: Dispatcher | None = None
        self._pending: set[_MemoryQuery] = set()
        self._expiring = False

    def link(self) -> MemoryLink:
        """A new link to this hub."""
        made = MemoryLink(self)
        with self._lock:
            self._links.append(made)
            self._dispatcher = self._dispatcher or Dispatcher("memory-hub")
        return made

    def _expire_soon(self) -> None:
        if self._pending and not self._expiring and self._dispatcher is not None:
            self._expiring = True
            self._dispatcher.post(self._expire, 0.02)

    def _expire(self) -> None:
        now = time.monotonic()
        with self._lock:
            late = [query for query in self._pending if query.deadline <= now]
        for query in late:
            query.end(Unanswered(f"no reply on {query.key} within the timeout"))
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
                dispatcher.post(lambda: done(Unanswered(f"no process serves {key}")))
                return
            server, handler = found[0]
            query = _MemoryQuery(self, server, key, payload, done, time.monotonic() + timeout_s)
            self._hub._pending.add(query)
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
                        mailbox.put(key, payload, droppable=droppable or may_drop(key))

    def has_subscribers(self, key: str) -> bool:
        with self._hub._lock:
            self._dispatcher()
            return any(matches(expr, key) for link in self._hub._links for expr, _ in link._mailboxes)

    def subscribe(self, key_expr: str, handler: Callable[[str, bytes], None]) -> None:
        with self._hub._lock:
            self._dispatcher()
            self._mailboxes.append((key_expr, Mailbox(handler)))

    def announce(self, key: str) -> None:
        with self._hub._lock:
            self._dispatcher()
            self._alive.add(key)
            self._notify_watchers(key, True)

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
                self._notify_watchers(key, False)
            cut = [query for query in hub._pending if self in (query.sender, query.server)]
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

    def _notify_watchers(self, key: str, alive: bool) -> None:
        for link in self._hub._links:
            for expr, mailbox in link._watchers:
                if matches(expr, key):
                    mailbox.put(key.rpartition("/")[2], alive, droppable=False)


class _MemoryQuery:
    def __init__(self, sender: MemoryLink, server: MemoryLink, key: str, payload: bytes, done: Done, deadline: float) -> None:
        self.sender, self.server = sender, server
        self.key, self.payload, self.deadline = key, payload, deadline
        self._done = done
        self._answered = False

    def reply(self, payload: bytes) -> None:
        self._answer(bytes(payload))

    def refuse(self, reason: str) -> None:
        self._answer(Refused(reason))

    def end(self, outcome: Outcome) -> None:
        """Give the outcome to the sender, on the hub's thread; outcomes after the first are ignored."""
        with self.sender._hub._lock:
            if self not in self.sender._hub._pending:
                return
            self.sender._hub._pending.remove(self)
        self._done(outcome)

    def _answer(self, outcome: Outcome) -> None:
        with self.sender._hub._lock:
            if self._answered:
                raise RuntimeError(f"this query on {self.key} has been answered already")
            self._answered = True
            dispatcher = self.sender._hub._dispatcher
            if dispatcher is not None:
                dispatcher.post(lambda: self.end(outcome))
