"""The network interface of the system: the keys of a run, and the protocol of a link between processes.

``memory_link.MemoryLink`` implements it within one process, ``zenoh_link.ZenohLink`` between
nodes.  The same contract tests run on both.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

_log = logging.getLogger(__name__)

WORKER_TOPICS = ("worker", "trajectories", "episode", "belief")
"""The topics of the monitor plane on which workers publish, each followed by the worker's name; the learner owns the others."""


@dataclass(frozen=True, slots=True)
class StreamKeys:
    """The keys of one run's streams.  Raises ValueError for a name that cannot be part of a key."""

    run: str

    def __post_init__(self) -> None:
        _part(self.run)

    @property
    def data(self) -> str:
        """Workers send trajectories here; the learner replies when they are stored."""
        return f"icrl/{self.run}/data"

    @property
    def work(self) -> str:
        """Workers request jobs here."""
        return f"icrl/{self.run}/work"

    @property
    def weights(self) -> str:
        """The learner publishes every new weights version here."""
        return f"icrl/{self.run}/weights"

    @property
    def weights_latest(self) -> str:
        """The learner answers requests for the newest or an older weights version here."""
        return f"icrl/{self.run}/weights/latest"

    @property
    def monitor_all(self) -> str:
        """All topics of the monitor plane."""
        return f"icrl/{self.run}/mon/**"

    @property
    def past(self) -> str:
        """The learner answers requests of monitors for what the run has done so far here."""
        return f"icrl/{self.run}/mon/past"

    @property
    def monitor_of_workers(self) -> tuple[str, ...]:
        """The part of the monitor plane on which workers publish."""
        return tuple(f"icrl/{self.run}/mon/{topic}/*" for topic in WORKER_TOPICS)

    @property
    def heartbeats(self) -> str:
        """Every worker's heartbeat on the monitor plane."""
        return f"icrl/{self.run}/mon/worker/*"

    @property
    def alive_all(self) -> str:
        """The liveliness tokens of all workers."""
        return f"icrl/{self.run}/alive/*"

    def monitor(self, topic: str) -> str:
        """One topic of the monitor plane, such as ``trajectories/w0``."""
        for part in topic.split("/"):
            _part(part)
        return f"icrl/{self.run}/mon/{topic}"

    def alive(self, worker: str) -> str:
        """The liveliness token of one worker."""
        return f"icrl/{self.run}/alive/{_part(worker)}"


def may_drop(key: str) -> bool:
    """Whether a subscriber may drop messages on ``key``, whatever their sender asks for: those of the monitor plane."""
    return key.split("/", 3)[2:3] == ["mon"]


def _part(name: str) -> str:
    if not name or any(c in "/*$?#" or not c.isprintable() for c in name):
        raise ValueError(
            f"{name!r} cannot be part of a key: it must not be empty nor hold any of / * $ ? # or unprintable characters"
        )
    return name


class LinkError(OSError):
    """A link cannot be opened, or is closed; the message names the link and the remedy."""


LOST = "lost"
"""In the reason of a refused request for weights: they do not exist any more, so asking again is useless."""


class Refused(Exception):  # noqa: N818
    """The other side refused the request and gave a reason."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Unanswered(Exception):  # noqa: N818
    """No reply came: no process serves the key, it was too slow, or the link broke."""


Outcome = bytes | Refused | Unanswered
Done = Callable[[Outcome], None]


class Query(Protocol):
    """A request, as its server receives it; the server answers it once, from any thread, at any time.

    An answer that cannot reach the other side is lost: the request ends Unanswered there.  A
    second answer raises RuntimeError.
    """

    @property
    def key(self) -> str: ...

    @property
    def payload(self) -> bytes: ...

    def reply(self, payload: bytes) -> None: ...

    def refuse(self, reason: str) -> None: ...


class Link(Protocol):
    """The connection of one process to the streams.  Using a closed link raises LinkError."""

    def request(self, key: str, payload: bytes, timeout_s: float) -> bytes:
        """Send a request and wait for the reply.  Raises Refused or Unanswered.  Must not be called from a handler."""
        answers: queue.SimpleQueue[Outcome] = queue.SimpleQueue()
        self.send(key, payload, timeout_s, answers.put)
        try:
            outcome = answers.get(timeout=timeout_s + 5.0)  # the link ends requests at their deadline, unless it is stuck
        except queue.Empty:
            raise Unanswered(f"the link is stuck: no outcome on {key} 5 s after the timeout of {timeout_s:g} s") from None
        if isinstance(outcome, bytes):
            return outcome
        raise outcome

    def send(self, key: str, payload: bytes, timeout_s: float, done: Done) -> None:
        """Send a request without waiting; ``done`` is called once with the outcome, from another thread.

        ``done`` must not block and must not use a link: it may run on the network's own thread,
        while that holds locks.
        """

    def serve(self, key: str, handler: Callable[[Query], None]) -> None:
        """Answer requests for ``key``.  The handler must not block; an error that it raises becomes the answer."""

    def publish(self, key: str, payload: bytes, droppable: bool) -> None:
        """Send a message to all subscribers.  A droppable message is dropped where it would have to wait."""

    def has_subscribers(self, key: str) -> bool:
        """Whether a droppable message on ``key`` would have a subscriber, according to the declarations received so far."""

    def subscribe(self, key_expr: str, handler: Callable[[str, bytes], None]) -> None:
        """Call ``handler``, on a thread of its own, with each message on ``key_expr`` (``*`` one part, ``**`` any number).

        A slow handler misses droppable messages; it does not delay publishers or other subscribers.
        """

    def announce(self, key: str) -> None:
        """Hold a liveliness token for ``key`` until this link closes or its process dies."""

    def watch(self, key_expr: str, handler: Callable[[str, bool], None]) -> None:
        """Call ``handler`` with the last part of each key whose token appears (True, also for present ones) or goes (False)."""

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The endpoints to which other links can connect."""

    def close(self) -> None:
        """Close the link; pending requests end Unanswered.  A second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def matches(key_expr: str, key: str) -> bool:
    """Whether a key expression matches a key: ``*`` stands for one part, ``**`` for any number."""
    return _covers(key_expr.split("/"), key.split("/"))


def _covers(expr: list[str], key: list[str]) -> bool:
    if not expr:
        return not key
    if expr[0] == "**":
        return any(_covers(expr[1:], key[i:]) for i in range(len(key) + 1))
    return bool(key) and expr[0] in ("*", key[0]) and _covers(expr[1:], key[1:])
