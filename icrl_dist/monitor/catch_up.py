"""Requests to a learner for what its run has done before this view joined, and for messages that were lost."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Iterable, Sequence

from icrl_dist.monitor import past
from icrl_dist.monitor.metric_messages import Message
from icrl_dist.monitor.run_state import RunState
from icrl_dist.stream.link import Link, LinkError, Refused, StreamKeys, Unanswered
from icrl_dist.stream.validation import WireError

_log = logging.getLogger(__name__)

_ANSWER_S = 10.0
_ATTEMPTS = 30
"""Requests for one page of returns; a busy learner refuses some."""
_RETRY_S = 1.0
_MAX_PHASES = 64
"""Phases that are requested at the start, the newest, until every variation has as many as a view keeps."""


def play(state: RunState, messages: Iterable[Message], partial: bool = False, apart_s: float = 0.0) -> None:
    """Receive recorded messages, with a tick after every recorded second, as in a live run; the rest as in ``tick``."""
    last: float | None = None
    for at, key, payload in messages:
        state.receive(key, payload, at)
        if last is None:
            last = at
        if at - last >= 1.0:  # after the message, so that a rate is over the time in which it was counted
            last = at
            state.tick(at, partial, apart_s)


class CatchUp:
    """Completes a run state.  ``begin`` and ``collected`` do not wait for returns, which a thread requests."""

    def __init__(self, link: Link, state: RunState) -> None:
        self._link, self._state = link, state
        self._wanted: queue.SimpleQueue[tuple[str, str, Sequence[str]] | None] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="catch-up", daemon=True)
        self._thread.start()

    def begin(self, run: str) -> None:
        """Replace the state by the past of ``run`` from its metrics, then request the returns of its phases."""
        messages = None
        try:
            messages, _ = self._ask(StreamKeys(run).past, past.request(), 3, Refused)
        except (WireError, ValueError, Refused, Unanswered, LinkError) as error:
            _log.warning("the past of %s is missing: %s", run, error)
        self._state.clear()
        if messages is not None:
            play(self._state, messages, partial=True, apart_s=past.apart_s([at for at, _, _ in messages]))
        self._state.past = "missing" if messages is None else "loading"
        phases = self._state.phases_so_far[::-1][:_MAX_PHASES]
        self._wanted.put((run, self._state.epoch, phases))

    def collected(self, run: str, phase: str) -> None:
        """Request the returns of a phase whose collection has ended, because messages may have been lost."""
        self._wanted.put((run, self._state.epoch, [phase]))

    def close(self) -> None:
        self._ended.set()
        self._wanted.put(None)
        self._thread.join(5.0)

    def _work(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            run, epoch, phases = wanted
            try:
                for number, phase in enumerate(phases):
                    self._fetch(run, epoch, phase)
                    if self._state.epoch != epoch or self._state.has_all_phases(number + 1):
                        break
                if self._state.epoch == epoch and self._state.past == "loading":
                    self._state.past = ""
            except (WireError, ValueError, Refused, Unanswered, LinkError) as error:
                if not self._ended.is_set():
                    _log.warning("returns of %s were not received: %s", run, error)
                    if self._state.epoch == epoch and self._state.past == "loading":
                        self._state.past = "missing"

    def _fetch(self, run: str, epoch: str, phase: str) -> None:
        after = ""
        while self._state.epoch == epoch:
            messages, after = self._ask(StreamKeys(run).past, past.request(phase, after), _ATTEMPTS, Refused, Unanswered)
            for _, key, payload in messages:
                self._state.receive(key, payload, time.time(), past=True)
            if not after:
                return

    def _ask(self, key: str, request: bytes, attempts: int, *again: type[Exception]) -> tuple[list[Message], str]:
        """The reply to a request, which is repeated after the exceptions ``again``."""
        for left in range(attempts - 1, -1, -1):
            try:
                return past.parse_reply(self._link.request(key, request, _ANSWER_S))
            except again:
                if not left or self._ended.wait(_RETRY_S):
                    raise
        raise AssertionError
