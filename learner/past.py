"""Answers the requests of views for what the run has done so far.

Nothing is read and no thread runs until the first request.  Answers take at most a tenth of the time of one thread, so they
cannot slow the fit or the ingest.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from pathlib import Path

from icrl_dist.config.run import Run
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream.link import Link, Query, StreamKeys
from icrl_dist.stream.validation import WireError

_log = logging.getLogger(__name__)

_QUEUED = 8
"""Requests that wait; a further one is refused as ``busy``, and the view asks again."""
_REST = 9
"""Time between two answers, in times that an answer takes."""


class PastServer:
    """Answers one request at a time; ``monitor/past.py`` makes the answers."""

    def __init__(self, link: Link, keys: StreamKeys, run: Run, folder: Path, store: Dataset) -> None:
        self._run, self._folder, self._store = run, folder, store
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._queue: queue.SimpleQueue[Query | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        link.serve(keys.past, self.put)

    def put(self, query: Query) -> None:
        """Queue a request without blocking."""
        with self._lock:
            if self._closed.is_set() or self._queue.qsize() >= _QUEUED:
                query.refuse("busy")
                return
            self._queue.put(query)
            if self._thread is None:
                self._thread = threading.Thread(target=self._answer, name="past", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Refuse further requests, and wait for the present answer; the store may be closed afterwards."""
        with self._lock:
            self._closed.set()
            self._queue.put(None)
        if self._thread is not None:
            self._thread.join()

    def _answer(self) -> None:
        from icrl_dist.monitor.past import REQUEST_BYTES, Past  # only where somebody asks

        past: Past | None = None
        while (query := self._queue.get()) is not None:
            if self._closed.is_set():
                query.refuse("busy")
                continue
            began = time.monotonic()
            try:
                if len(query.payload) > REQUEST_BYTES:
                    raise WireError("oversized", f"{len(query.payload)} bytes, the limit is {REQUEST_BYTES}")
                past = past or Past(self._run, self._folder, self._store)
                query.reply(past.answer(query.payload))
            except WireError as error:
                query.refuse(str(error))
            except Exception as error:  # such as damaged data, which the learner itself finds and repairs
                _log.exception("a request for the past could not be answered")
                query.refuse(f"unavailable: {type(error).__name__}")
            self._closed.wait(min(_REST * (time.monotonic() - began), 5.0))
