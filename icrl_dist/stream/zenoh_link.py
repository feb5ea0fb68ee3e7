"""A link between nodes: the only file that imports Zenoh.

The learner listens.  Workers and taps are its clients and reconnect by themselves when it comes
back.  Discovery and shared memory are off: only configured connections exist.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import itertools
import json
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import zenoh
from zenoh import CongestionControl, ConsolidationMode, Priority
from zenoh.handlers import Callback

from icrl_dist.stream import endpoints
from icrl_dist.stream.admission import Admission, Descriptors
from icrl_dist.stream.dispatch import Dispatcher, Mailbox, handle
from icrl_dist.stream.link import (
    Done,
    Link,
    LinkError,
    Outcome,
    Query,
    Refused,
    Unanswered,
    may_drop,
)

_REFUSED = b"refused: "
"""Prefix of our refusals: Zenoh sends error replies of its own too (``Timeout``)."""


class ZenohLink(Link):
    """A Zenoh session as a link; open one with :meth:`listen` or :meth:`connect`.

    Handlers of requests and ``done`` run on Zenoh's own threads.
    """

    def __init__(self, session: zenoh.Session, endpoint: str) -> None:
        self._session = session
        self._endpoint = endpoint
        self._lock = threading.Lock()
        self._closed = False
        self._numbers = itertools.count()
        self._pending: dict[int, Done] = {}
        self._declaring = threading.Lock()
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._mailboxes: list[Mailbox] = []
        self._declared: list[object] = []
        self._dispatcher = Dispatcher("zenoh-link")
        self._admission: Admission | None = None
        atexit.register(self.close)

    @classmethod
    def listen(cls, endpoint: str, config: Mapping[str, object] | None = None, largest: int = 64 << 20) -> ZenohLink:
        """Listen on ``endpoint``, such as ``tcp/127.0.0.1:7447``; with port 0 on a free port.

        ``config`` sets further Zenoh keys (TLS, access control).  A message of more than ``largest`` bytes is dropped
        before it is complete.  Raises LinkError if it cannot listen there.
        """
        descriptors = Descriptors()
        limits = {
            "transport/unicast/max_sessions": descriptors.sessions,
            "transport/unicast/accept_timeout": 5_000,
            "transport/link/rx/max_message_size": largest,
        }
        settings = {"mode": "peer", "connect/endpoints": [], **limits, **(config or {})}
        for left in range(9, -1, -1):
            bound = _with_port(endpoint)
            try:
                link = cls(_open({**settings, "listen/endpoints": [bound]}), bound)
                link._admit(Admission(endpoints.parse(bound).port, descriptors))
                return link
            except LinkError as error:
                if bound == endpoint or not left:
                    raise LinkError(f"cannot listen on {endpoint}: {error}; free that port or name another") from error
        raise AssertionError

    @classmethod
    def connect(cls, endpoint: str, timeout_s: float, config: Mapping[str, object] | None = None) -> ZenohLink:
        """Connect to a link that listens on ``endpoint``; a lost connection is opened again automatically.

        ``config`` as in :meth:`listen`.  Raises LinkError if there is no connection within ``timeout_s``.
        """
        settings = {
            "mode": "client",
            "listen/endpoints": [],
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": int(timeout_s * 1000),
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
            **(config or {}),
        }
        try:
            return cls(_open(settings), endpoint)
        except LinkError as error:
            raise LinkError(
                f"cannot connect to {endpoint} within {timeout_s:g} s: {error}; check that the learner runs and listens there"
            ) from error

    def _admit(self, admission: Admission) -> None:
        def on_link(event: zenoh.LinkEvent) -> None:
            peer = str(event.link.dst).partition("/")[2]
            admission.session(event.kind == zenoh.SampleKind.PUT, event.link.auth_identifier, peer)

        self._admission = admission
        info = self._session.info
        self._declared.append(info.declare_link_events_listener(Callback(on_link, indirect=False), history=True))

    def send(self, key: str, payload: bytes, timeout_s: float, done: Done) -> None:
        number, caller = next(self._numbers), threading.get_ident()
        pending = self._pending
        pending[number] = done  # the code that removes it calls it, so it is called once

        def settle(outcome: Outcome) -> None:
            waiting = pending.pop(number, None)
            if waiting is None:
                return
            if threading.get_ident() == caller:
                self._dispatcher.post(lambda: waiting(outcome))
            else:
                waiting(outcome)

        def on_reply(reply: zenoh.Reply) -> None:
            settle(_outcome(reply))

        def on_end() -> None:
            if number in pending:
                settle(Unanswered(f"no process answered on {key}"))

        try:
            with self._errors():
                self._querier(key, timeout_s).get(Callback(on_reply, on_end, indirect=False), payload=payload)
        except LinkError:
            if self._closed and pending.pop(number, None) is not None:
                raise
            settle(Unanswered(f"the request on {key} could not be sent"))

    def serve(self, key: str, handler: Callable[[Query], None]) -> None:
        def answer(query: zenoh.Query) -> None:
            handle(handler, _ZenohQuery(query))

        with self._errors():
            self._declared.append(self._session.declare_queryable(key, Callback(answer, indirect=False), complete=True))

    def publish(self, key: str, payload: bytes, droppable: bool) -> None:
        with self._errors():
            self._publisher(key, droppable).put(payload)

    def has_subscribers(self, key: str) -> bool:
        with self._errors():
            status: Any = self._publisher(key, droppable=True).matching_status  # no bool: always true
            return bool(status.matching)

    def subscribe(self, key_expr: str, handler: Callable[[str, bytes], None]) -> None:
        mailbox = self._mailbox(handler)

        def on_sample(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            droppable = sample.congestion_control == CongestionControl.DROP or may_drop(key)
            mailbox.put(key, sample.payload.to_bytes(), droppable=droppable)

        with self._errors():
            self._declared.append(self._session.declare_subscriber(key_expr, Callback(on_sample, indirect=False)))

    def announce(self, key: str) -> None:
        with self._errors():
            self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key_expr: str, handler: Callable[[str, bool], None]) -> None:
        mailbox = self._mailbox(handler)

        def on_sample(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            mailbox.put(str(sample.key_expr).rpartition("/")[2], alive, droppable=False)

        with self._errors():
            liveliness = self._session.liveliness()
            self._declared.append(liveliness.declare_subscriber(key_expr, Callback(on_sample, indirect=False), history=True))

    @property
    def endpoints(self) -> tuple[str, ...]:
        return (self._endpoint,)

    def close(self) -> None:
        with self._lock:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self.close)
        if self._admission is not None:
            self._admission.close()
        self._session.close()  # type: ignore[no-untyped-call]
        for number in list(self._pending):
            if (done := self._pending.pop(number, None)) is not None:
                self._dispatcher.post(functools.partial(done, Unanswered("the link was closed")))
        for mailbox in self._mailboxes:
            mailbox.close()
        self._dispatcher.close()

    def _publisher(self, key: str, droppable: bool) -> zenoh.Publisher:
        with self._declaring:
            publisher = self._publishers.get((key, droppable))
            if publisher is None:
                publisher = self._publishers[key, droppable] = self._session.declare_publisher(
                    key,
                    congestion_control=CongestionControl.DROP if droppable else CongestionControl.BLOCK,
                    priority=Priority.BACKGROUND if droppable else Priority.DATA,
                )
        return publisher

    def _querier(self, key: str, timeout_s: float) -> zenoh.Querier:
        querier = self._queriers.get((key, timeout_s))
        if querier is None:
            with self._declaring:
                querier = self._queriers.get((key, timeout_s))
                if querier is None:
                    querier = self._queriers[key, timeout_s] = self._session.declare_querier(
                        key,
                        timeout=timeout_s,
                        consolidation=ConsolidationMode.NONE,
                        congestion_control=CongestionControl.BLOCK,
                    )
        return querier

    def _mailbox(self, handler: Callable[..., None]) -> Mailbox:
        mailbox = Mailbox(handler)
        with self._lock:
            self._mailboxes.append(mailbox)
        return mailbox

    def _check_open(self) -> None:
        if self._closed:
            raise LinkError(f"the link to {self._endpoint} is closed: open another")

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        self._check_open()
        try:
            yield
        except zenoh.ZError as error:
            self._check_open()
            raise LinkError(f"{self._endpoint}: {_brief(error)}") from error


class _ZenohQuery:
    def __init__(self, query: zenoh.Query) -> None:
        self.key = str(query.key_expr)
        self.payload = query.payload.to_bytes() if query.payload is not None else b""
        self._lock = threading.Lock()
        self._query: zenoh.Query | None = query

    def reply(self, payload: bytes) -> None:
        query = self._claim()
        with contextlib.suppress(zenoh.ZError):
            query.reply(self.key, payload)
        query.drop()  # type: ignore[no-untyped-call]

    def refuse(self, reason: str) -> None:
        query = self._claim()
        with contextlib.suppress(zenoh.ZError):
            query.reply_err(_REFUSED + reason.encode("utf-8", "replace"))
        query.drop()  # type: ignore[no-untyped-call]

    def _claim(self) -> zenoh.Query:
        with self._lock:
            query, self._query = self._query, None
        if query is None:
            raise RuntimeError(f"this query on {self.key} has been answered already")
        return query


def _outcome(reply: zenoh.Reply) -> Outcome:
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    error = reply.err.payload.to_bytes() if reply.err is not None else b""
    if error.startswith(_REFUSED):
        return Refused(error[len(_REFUSED) :].decode("utf-8", "replace"))
    return Unanswered(error.decode("utf-8", "replace"))


_RUNTIME = "(rx: (worker_threads: 1), {rest}, app: (worker_threads: 1))".format(
    rest=", ".join(f"{name}: (handover: app)" for name in ("acc", "tx", "net"))
)
"""Zenoh's threads: one for receiving, one for the rest; the default of six takes a third more CPU time a message."""


def _open(settings: Mapping[str, object]) -> zenoh.Session:
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)  # Zenoh reads it once, when the process opens its first session
    common: dict[str, object] = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/size/data": 8,  # a request of several trajectories is sent without waiting
        "transport/link/rx/buffer_size": 1 << 18,  # and received with few reads
    }
    config = zenoh.Config()
    try:
        for key, value in {**common, **settings}.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise LinkError(_brief(error)) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise LinkError(f"Zenoh panicked: {_brief(error)}") from error


def _with_port(endpoint: str) -> str:
    """The endpoint with a free port in place of port 0, because Zenoh does not report the port that it chose."""
    found = re.fullmatch(r"([a-z]+/)(.*):0([?#].*)?", endpoint)
    if found is None:
        return endpoint
    protocol, host, rest = found.groups()
    try:
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        kind = socket.SOCK_DGRAM if protocol in ("udp/", "quic/") else socket.SOCK_STREAM
        with socket.socket(family, kind) as probe:
            probe.bind((host.strip("[]"), 0))
            return f"{protocol}{host}:{probe.getsockname()[1]}{rest or ''}"
    except OSError as error:
        raise LinkError(f"cannot listen on {endpoint}: {error}; name an address of this node") from error


def _brief(error: BaseException) -> str:
    """Zenoh's message without the positions in its source code."""
    return re.sub(r" at /\S+", "", str(error)).strip()
