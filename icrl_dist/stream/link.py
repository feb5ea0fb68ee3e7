"""The seam between this project and a network: key names, and what a link between processes does.

``memory_link.MemoryLink`` does it within one process, ``zenoh_link.ZenohLink`` between machines;
one battery of tests runs over both.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StreamKeys:
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
    def heartbeats(self) -> str:
        """Every worker's heartbeat on the monitor plane."""
        return f"icrl/{self.run}/mon/worker/*"

    @property
    def alive_all(self) -> str:
        """The liveliness of every worker."""
        return f"icrl/{self.run}/alive/*"

    def monitor(self, topic: str) -> str:
        """One topic of the monitor plane, such as ``trajectories/w0``."""
        for part in topic.split("/"):
            _part(part)
        return f"icrl/{self.run}/mon/{topic}"

    def alive(self, worker: str) -> str:
        """The liveliness of one worker."""
        return f"icrl/{self.run}/alive/{_part(worker)}"


def may_drop(key: str) -> bool:
    """Whether messages on ``key`` are only looked at: a subscriber need not keep them all, whatever their sender says."""
    return key.split("/", 3)[2:3] == ["mon"]


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
        try:
            outcome = answers.get(timeout=timeout_s + 5.0)  # the link keeps the deadline; this is for one that is stuck
        except queue.Empty:
            raise Unanswered(f"the link is stuck: {key} was to be answered within {timeout_s:g} s") from None
        if isinstance(outcome, bytes):
            return outcome
        raise outcome

    def send(self, key: str, payload: bytes, timeout_s: float, done: Done) -> None:
        """Ask without waiting; ``done`` is called once, from another thread.

        It must neither block nor use a link: it may run on the network's own thread, within its locks.
        """

    def serve(self, key: str, handler: Callable[[Query], None]) -> None:
        """Answer requests for ``key``.  The handler must not block; if it raises, the error is the answer."""

    def publish(self, key: str, payload: bytes, droppable: bool) -> None:
        """Tell whoever subscribes.  What is droppable is dropped sooner than it makes anyone wait."""

    def watched(self, key: str) -> bool:
        """Whether somebody subscribes to what is published, droppable, under ``key``, as far as is known here by now."""

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
