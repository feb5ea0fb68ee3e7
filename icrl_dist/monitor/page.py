"""The live view in a browser: one picture, told to every viewer; docs/monitor.md says how."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import signal
import threading
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from icrl_dist.monitor.feed import Feed
from icrl_dist.monitor.event_stream import EventStream
from icrl_dist.monitor.serve import application, serving

_log = logging.getLogger(__name__)

PUSH_S = 0.25
"""Viewers are told this often."""
EVENT = "picture"


class SnapshotPublisher:
    """Tells a feed's picture to every viewer: whole to one that joins, then what has changed, made once for all."""

    def __init__(self, feed: Feed) -> None:
        self._feed, self.stream = feed, EventStream(self._whole)
        self._lock = threading.Lock()
        self._epoch, self._since = "", -1
        self._kept: tuple[str, int, str] = "", -1, ""

    def _picture(self, since: int) -> dict[str, Any]:
        return {**self._feed.state.snapshot(self._feed.now(), since), "replay": self._feed.replay()}

    def _whole(self) -> tuple[str, str]:
        """What a viewer begins with; those who join in one tick share it."""
        picture = self._feed.state
        with self._lock:
            if self._kept[:2] != (picture.epoch, picture.seq):
                whole = self._picture(-1)
                self._kept = whole["epoch"], whole["seq"], json.dumps(whole, allow_nan=False, separators=(",", ":"))
                if not self._epoch:
                    self._epoch, self._since = self._kept[:2]
            return EVENT, self._kept[2]

    def tell(self) -> None:
        """Tell those who look on what has changed since the last time."""
        with self._lock:
            if not self.stream.viewers:
                self._epoch, self._kept = "", ("", -1, "")
            elif self._epoch:  # else nobody has begun yet
                delta = self._picture(self._since)
                if delta["epoch"] != self._epoch:
                    delta = self._picture(-1)
                self.stream.publish(EVENT, delta)
                self._epoch, self._since = delta["epoch"], delta["seq"]  # not before it was told: it is tried again

    def go_on(self, over: threading.Event) -> None:
        """Tell four times a second until ``over``; what cannot be told is logged once a kind of error."""
        logged: set[type[Exception]] = set()
        while not over.wait(PUSH_S):
            try:
                self.tell()
            except Exception as error:
                if type(error) not in logged:
                    logged.add(type(error))
                    _log.exception("viewers cannot be told of this; further ones of its kind are not logged")

    def command(self, fields: dict[str, Any]) -> None:
        """``speed`` (seconds of then a second of now), ``paused`` and ``at`` (Unix seconds) of a recording.

        Raises ValueError for anything else, and for a run that is on.
        """
        if self._feed.replay() is None:
            raise ValueError("this run is on: only a recording can be stopped, hurried or wound")
        for name, value in fields.items():
            if name == "paused":
                if type(value) is not bool:
                    raise ValueError(f"paused={value!r:.40}: true or false")
            elif name not in ("speed", "at"):
                raise ValueError(f"{name[:40]!r}: unknown; speed, paused and at are known")
            elif type(value) not in (int, float) or not math.isfinite(value) or value <= 0:
                raise ValueError(f"{name}={value!r:.40}: a number above 0")
        self._feed.control(**fields)

    async def variation(self, request: Request) -> Response:
        """All that is kept of one variation, as JSON."""
        name = f"{request.path_params['task']}/{request.path_params['variation']}"
        found = await asyncio.to_thread(self._feed.state.variation, name)
        return PlainTextResponse("no such variation", 404) if found is None else JSONResponse(found)


@contextlib.contextmanager
def showing(feed: Feed, host: str, port: int) -> Iterator[str]:
    """Serve the page meanwhile; gives its URL.  Raises ConfigError if it cannot listen there."""
    teller, over = SnapshotPublisher(feed), threading.Event()

    routes = [Route("/variation/{task}/{variation}", teller.variation)]
    app = application("monitor.html", teller.stream, teller.command, routes)
    thread = threading.Thread(target=teller.go_on, args=(over,), name="teller", daemon=True)
    with serving(app, teller.stream, host, port) as url:
        thread.start()
        try:
            yield url
        finally:
            over.set()
            thread.join(5.0)


def serve(feed: Feed, host: str, port: int, console: Console) -> int:
    """Serve the page until Ctrl-C or SIGTERM; returns the exit code.  Raises ConfigError if it cannot listen there."""
    over = threading.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: over.set())
    with showing(feed, host, port) as url:
        console.print(f"the live view is at {url}  (Ctrl-C ends the view, not the run)", highlight=False, soft_wrap=True)
        over.wait()
    return 0
