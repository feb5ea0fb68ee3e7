"""The live view in a browser: serves snapshots of one run's state to many viewers (docs/monitor.md)."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import threading
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from icrl_dist.console.signals import on_signals
from icrl_dist.monitor.event_stream import EventStream
from icrl_dist.monitor.feed import Feed
from icrl_dist.monitor.serve import application, serving

_log = logging.getLogger(__name__)

PUSH_S = 0.25
"""Time between two snapshots."""
EVENT = "picture"


class SnapshotPublisher:
    """Publishes a feed's state: a full snapshot to a new viewer, then the changes, computed once for all viewers."""

    def __init__(self, feed: Feed) -> None:
        self._feed, self.stream = feed, EventStream(self._initial_event)
        self._lock = threading.Lock()
        self._epoch, self._since = "", -1
        self._cached: tuple[str, int, str] = "", -1, ""
        """Epoch, seq and JSON text of the newest full snapshot."""

    def _snapshot(self, since: int) -> dict[str, Any]:
        return {**self._feed.state.snapshot(self._feed.now(), since), "replay": self._feed.replay()}

    def _initial_event(self) -> tuple[str, str]:
        """A full snapshot; viewers that join in the same tick share it."""
        state = self._feed.state
        with self._lock:
            if self._cached[:2] != (state.epoch, state.seq):
                full = self._snapshot(-1)
                self._cached = full["epoch"], full["seq"], json.dumps(full, allow_nan=False, separators=(",", ":"))
                if not self._epoch:
                    self._epoch, self._since = self._cached[:2]
            return EVENT, self._cached[2]

    def publish(self) -> None:
        """Send what has changed since the last call to all viewers."""
        with self._lock:
            if not self.stream.viewers:
                self._epoch, self._cached = "", ("", -1, "")
            elif self._epoch:  # empty until the first viewer has its full snapshot
                delta = self._snapshot(self._since)
                if delta["epoch"] != self._epoch:
                    delta = self._snapshot(-1)
                self.stream.publish(EVENT, delta)
                self._epoch, self._since = delta["epoch"], delta["seq"]  # after publish: a failed change is sent next time

    def run(self, over: threading.Event) -> None:
        """Publish four times a second until ``over`` is set; log one error of each type."""
        logged: set[type[Exception]] = set()
        while not over.wait(PUSH_S):
            try:
                self.publish()
            except Exception as error:
                if type(error) not in logged:
                    logged.add(type(error))
                    _log.exception("a snapshot could not be sent to viewers; further errors of this type are not logged")

    def command(self, fields: dict[str, Any]) -> None:
        """Control a recording: ``speed`` (recorded seconds a second), ``paused``, ``at`` (Unix seconds).

        Raises ValueError for other fields or values, and for a live run.
        """
        if self._feed.replay() is None:
            raise ValueError("this run is live: only a recording has pause, speed and seek")
        for name, value in fields.items():
            if name == "paused":
                if type(value) is not bool:
                    raise ValueError(f"paused={value!r:.40}: must be true or false")
            elif name not in ("speed", "at"):
                raise ValueError(f"{name[:40]!r}: unknown field; the fields are speed, paused and at")
            elif type(value) not in (int, float) or not math.isfinite(value) or value <= 0:
                raise ValueError(f"{name}={value!r:.40}: must be a number above 0")
        self._feed.control(**fields)

    async def variation(self, request: Request) -> Response:
        """Endpoint: everything kept of one variation, as JSON."""
        name = f"{request.path_params['task']}/{request.path_params['variation']}"
        found = await asyncio.to_thread(self._feed.state.variation, name)
        return PlainTextResponse("no such variation", 404) if found is None else JSONResponse(found)


@contextlib.contextmanager
def serving_run(feed: Feed, host: str, port: int) -> Iterator[str]:
    """Context manager: serves the page and yields its URL.  Raises ConfigError if the address cannot be used."""
    publisher, over = SnapshotPublisher(feed), threading.Event()

    async def runs(_: Request) -> Response:
        return JSONResponse(None)  # a page of one run has no list

    routes = [Route("/variation/{task}/{variation}", publisher.variation), Route("/runs", runs)]
    app = application("monitor.html", publisher.stream, publisher.command, routes)
    thread = threading.Thread(target=publisher.run, args=(over,), name="publisher", daemon=True)
    with serving(app, publisher.stream, host, port) as url:
        thread.start()
        try:
            yield url
        finally:
            over.set()
            thread.join(5.0)


def serve(feed: Feed, host: str, port: int, console: Console) -> int:
    """Serve the page until Ctrl-C or SIGTERM; returns the exit code.  Raises ConfigError if the address cannot be used."""
    over = threading.Event()
    with on_signals(over.set), serving_run(feed, host, port) as url:
        console.print(f"the live view is at {url}  (Ctrl-C ends the view, not the run)", highlight=False, soft_wrap=True)
        over.wait()
    return 0
