"""One address for the runs of a folder: the list, and a stream of snapshots for each run that somebody watches."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.console.signals import on_signals
from icrl_dist.monitor.feed import Feed, LiveFeed, ReplayFeed
from icrl_dist.monitor.page import SnapshotPublisher
from icrl_dist.monitor.run_list import ListedRun, RunList, find
from icrl_dist.monitor.serve import application, serving
from icrl_dist.storage.files import StoreError
from icrl_dist.stream import security
from icrl_dist.stream.excerpts import plain
from icrl_dist.stream.link import LinkError
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import metric_rows

MAX_OPEN = 8
"""Runs that are watched at once; a run that nobody watches makes room for another."""
_IDLE_S = 60.0
"""A run that nobody has watched for this time is closed."""
_REOPEN_S = 10.0
"""A recording of a run that goes on is opened again this often."""
_PERIOD_S = 2.0
_CONNECT_S = 5.0

OpenFeed = Callable[[ListedRun], contextlib.AbstractContextManager[Feed]]
"""Opens a run.  Raises ConfigError, StoreError or LinkError if there is nothing to show, or nothing yet."""


@contextlib.contextmanager
def open_feed(run: ListedRun, speed: float = 10.0, certificates: str = "") -> Iterator[Feed]:
    """The feed of a run: of its learner if it is live, else a recording, which begins at its end."""
    if not run.live:
        with ReplayFeed(run.folder, speed, at_end=True) as replay:
            yield replay
        return
    stream = load_folder(run.folder).stream
    endpoint = stream.connect or (run.folder / "endpoint").read_text().strip()
    settings = security.client(certificates or stream.certificates, "monitor")
    with (
        ZenohLink.connect(endpoint, _CONNECT_S, settings) as link,
        LiveFeed(link, run.folder.resolve().name, run.folder) as feed,
    ):
        yield feed


class _Watched:
    """A run that is open, with the thread that publishes its snapshots."""

    def __init__(self, run: ListedRun, open_run: OpenFeed) -> None:
        self.run, self.asked = run, time.monotonic()
        self._stack, self._over = contextlib.ExitStack(), threading.Event()
        self._written = _written(run)
        self._feed, self._opened = self._stack.enter_context(open_run(run)), time.monotonic()
        self.publisher = SnapshotPublisher(self._feed)
        self._thread = threading.Thread(target=self.publisher.run, args=(self._over,), name="publisher", daemon=True)
        self._thread.start()

    @property
    def behind(self) -> bool:
        """Whether it is a recording at its end and the run has gone on: a run in one process has no learner to connect to."""
        replay = self._feed.replay()
        if not self.run.held or replay is None or replay["at"] < replay["end"] or time.monotonic() - self._opened < _REOPEN_S:
            return False
        return _written(self.run) != self._written

    @property
    def watched(self) -> bool:
        """Whether a viewer is connected or has asked a short time ago; remembers when one was last seen."""
        if self.publisher.stream.viewers:
            self.asked = time.monotonic()
        return time.monotonic() - self.asked < _PERIOD_S

    def close(self) -> None:
        self.publisher.stream.close()
        self._over.set()
        self._thread.join(5.0)
        self._stack.close()


def _written(run: ListedRun) -> float:
    """When the metrics of a run were written last."""
    try:
        return (run.folder / metric_rows.NAME).stat().st_mtime
    except OSError:
        return 0.0


class FolderViews:
    """The runs of a folder for a page: opens a run when a viewer asks for it, and closes it when nobody watches it."""

    def __init__(self, folder: Path, open_run: OpenFeed) -> None:
        self._folder, self._open_run = folder, open_run
        self._list = RunList(folder)
        self._lock, self._open, self._closed = threading.Lock(), dict[str, _Watched](), False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="folder", daemon=True)
        self._thread.start()

    def watched(self, name: str) -> _Watched:
        """The run of this name, opened if it is not open yet.

        A name is looked up in the list, and never becomes part of a path.  Raises KeyError for a name that is not in
        the list, and what ``OpenFeed`` raises.
        """
        with self._lock:
            run = next((run for run in find(self._folder) if run.name == name), None)
            if run is None or self._closed:
                raise KeyError(name)
            if name not in self._open:
                self._make_room()
                self._open[name] = _Watched(run, self._open_run)
            self._open[name].asked = time.monotonic()
            return self._open[name]

    def _make_room(self) -> None:
        if len(self._open) < MAX_OPEN:
            return
        idle = [name for name, one in self._open.items() if not one.watched]
        if not idle:
            raise ConfigError(f"{MAX_OPEN} runs are watched at once, the limit: close the page of one")
        self._open.pop(min(idle, key=lambda name: self._open[name].asked)).close()

    def refresh(self) -> None:
        """Close the runs that nobody watches, that are gone, or that were resumed; a viewer of such a run connects again."""
        with self._lock:
            now = {run.name: run for run in find(self._folder)}
            for name, one in list(self._open.items()):
                run = now.get(name)
                resumed = run is not None and run.live and (not one.run.live or run.began != one.run.began)
                if run is None or resumed or one.behind or not (one.watched or time.monotonic() - one.asked < _IDLE_S):
                    self._open.pop(name).close()

    def _watch(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            self.refresh()

    def close(self) -> None:
        self._ended.set()
        self._thread.join(10.0)
        with self._lock:
            self._closed = True
            for one in self._open.values():
                one.close()
            self._open.clear()
        self._list.close()

    # Endpoints.

    async def _asked(self, request: Request) -> _Watched | Response:
        """The run that a request names, or the answer that says why it is not shown."""
        name = request.query_params.get("run", "")
        try:
            return await asyncio.to_thread(self.watched, name)
        except KeyError:
            return PlainTextResponse(f"no run {plain(name)!r} in this folder", 404)
        except (ConfigError, StoreError, LinkError, OSError, ValueError) as error:
            return PlainTextResponse(plain(str(error)), 503)

    async def respond(self, request: Request) -> Response:
        """``/events?run=NAME``: the snapshots of a run."""
        found = await self._asked(request)
        return found if isinstance(found, Response) else await found.publisher.stream.respond(request)

    async def variation(self, request: Request) -> Response:
        """``/variation/TASK/VARIATION?run=NAME``: everything kept of one variation."""
        found = await self._asked(request)
        return found if isinstance(found, Response) else await found.publisher.variation(request)

    async def runs(self, _: Request) -> Response:
        """``/runs``: the list."""
        return JSONResponse(self._list.listed())

    def command(self, fields: dict[str, Any]) -> None:
        """Control the recording of the run that ``run`` names.  Raises ValueError as ``SnapshotPublisher.command``."""
        name = fields.pop("run", "")
        one = self._open.get(name) if isinstance(name, str) else None
        if one is None:
            raise ValueError("no open run has this name")
        one.publisher.command(fields)


@contextlib.contextmanager
def serving_folder(folder: Path, host: str, port: int, open_run: OpenFeed = open_feed) -> Iterator[str]:
    """Context manager: serves the page of a folder and yields its URL.  Raises ConfigError for an unusable address."""
    with contextlib.closing(FolderViews(folder, open_run)) as views:
        routes = [Route("/variation/{task}/{variation}", views.variation), Route("/runs", views.runs)]
        with serving(application("monitor.html", views, views.command, routes), views, host, port) as url:
            yield url


def serve(folder: Path, host: str, port: int, open_run: OpenFeed, console: Console) -> int:
    """Serve the page of a folder until Ctrl-C or SIGTERM; returns the exit code.  Raises ConfigError as above."""
    over = threading.Event()
    with on_signals(over.set), serving_folder(folder, host, port, open_run) as url:
        text = f"the runs of {plain(str(folder))} are at {url}  (Ctrl-C ends the view, not a run)"
        console.print(text, highlight=False, soft_wrap=True, markup=False)
        if not find(folder):
            console.print(_waiting(folder), highlight=False, soft_wrap=True, markup=False)
        over.wait()
    return 0


def watch(folder: Path, open_run: OpenFeed, console: Console) -> int:
    """Show the newest run in the terminal until the user quits; a run that begins later replaces it.

    Waits for the first run.  Returns the exit code.
    """
    from icrl_dist.monitor import screen

    ended, said = threading.Event(), ""
    while True:
        newest, text = next(iter(find(folder)), None), _waiting(folder)
        if newest is not None:
            try:
                with open_run(newest) as feed:
                    code = screen.watch(feed, functools.partial(_newer, folder, newest))
                if code is not None:
                    return code
                continue
            except (ConfigError, StoreError, LinkError, OSError) as error:
                text = f"waiting: {plain(str(error))}"
        if text != said:
            said = text
            console.print(f"{text}  (Ctrl-C ends the view)", highlight=False, soft_wrap=True, markup=False)
        with on_signals(ended.set):
            if ended.wait(_PERIOD_S):
                return screen.INTERRUPTED


def _waiting(folder: Path) -> str:
    missing = "" if folder.is_dir() else ", which does not exist yet"
    return f"waiting for the first run in {plain(str(folder))}{missing}"


def _newer(folder: Path, shown: ListedRun) -> bool:
    """Whether a run that can be shown is newer than the shown one, which may have been resumed itself."""
    newest = next(iter(find(folder)), None)
    if newest is None or not newest.live:
        return False
    return newest.name != shown.name or newest.began != shown.began
