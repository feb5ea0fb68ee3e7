"""What every page of the live view needs: a server in a thread, events to many viewers, commands from them.

One process serves one page to whoever may reach it.  Nothing is loaded from elsewhere, no
script stands in a page, and a command is taken only from the page itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from importlib import resources
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from icrl_dist.config.run import ConfigError

VIEWERS = 64
"""Viewers of one page at once; further ones are told to come back."""
QUEUED = 256
"""Events that wait for one viewer; the oldest are dropped for a viewer that is slower."""
BEHIND = 16
"""Events that wait for one viewer where each builds on the one before; a slower viewer is greeted anew."""
BODY = 4096
"""Bytes of a command."""
_QUIET_S = 10.0
"""After so long without an event a viewer is sent a comment, so that a lost one is noticed."""
_HOME = {"127.0.0.1", "localhost", "::1"}
_ASSETS = resources.files("icrl_dist.monitor") / "assets"
_KINDS = {"css": "text/css", "html": "text/html", "js": "text/javascript", "svg": "image/svg+xml", "LICENSE": "text/plain"}
_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}

Command = Callable[[dict[str, Any]], None]
"""Does what a viewer's JSON object asks for, on a thread of the server.  Raises ValueError with one line if it cannot."""


class EventStream:
    """Events from any thread to any number of viewers, none of whom can slow the teller or another.

    A *state* event replaces one of its name that a viewer has not been sent yet, and is the
    first that a new viewer hears; any other is sent once, or dropped if the viewer is slow.

    Where each event builds on the one before there is a ``greeting``: the event that a viewer
    can begin with.  It gives event and JSON text, on a thread of the server, once the viewer
    is among those who are told; a viewer that fell behind begins with it anew.
    """

    def __init__(self, greeting: Callable[[], tuple[str, str]] | None = None) -> None:
        self._greeting = greeting
        self._lock = threading.Lock()
        self._viewers: set[_Viewer] = set()
        self._state: dict[str, str] = {}
        self._closed = False

    def publish(self, event: str, data: object, state: bool = False) -> None:
        """Tell every viewer ``data``, as JSON.  Raises ValueError for what JSON cannot say (NaN)."""
        text = json.dumps(data, allow_nan=False, separators=(",", ":"))
        with self._lock:
            if state:
                self._state[event] = text
            for viewer in self._viewers:
                viewer.put(event, text, state)

    @property
    def viewers(self) -> int:
        """How many look on now."""
        return len(self._viewers)

    def close(self) -> None:
        """Let every viewer go, and take no more."""
        with self._lock:
            self._closed = True
            for viewer in self._viewers:
                viewer.end()

    async def _events(self) -> AsyncIterator[str]:
        viewer = _Viewer(asyncio.get_running_loop(), self._greeting)
        with self._lock:
            for event, text in self._state.items():
                viewer.put(event, text, True)
            self._viewers.add(viewer)
            if self._closed:
                viewer.end()
        try:
            yield "retry: 1000\n\n"
            while (chunk := await viewer.next()) is not None:
                yield chunk
        finally:
            with self._lock:
                self._viewers.discard(viewer)

    async def respond(self, request: Request) -> Response:
        """The endpoint: server-sent events until the viewer goes or the stream is closed."""
        if len(self._viewers) >= VIEWERS:
            return PlainTextResponse(f"{len(self._viewers)} viewers are here already: close one", 503)
        return StreamingResponse(self._events(), media_type="text/event-stream")


class _Viewer:
    """What one viewer has still to be sent."""

    def __init__(self, loop: asyncio.AbstractEventLoop, greeting: Callable[[], tuple[str, str]] | None = None) -> None:
        self._loop, self._lock, self._some = loop, threading.Lock(), asyncio.Event()
        self._queue: deque[tuple[str, str, bool]] = deque()
        self._over = False
        self._greeting, self._greet = greeting, greeting is not None

    def put(self, event: str, text: str, state: bool) -> None:
        with self._lock:
            if state:
                self._queue = deque(one for one in self._queue if not (one[2] and one[0] == event))
            self._queue.append((event, text, state))
            if self._greeting is not None and len(self._queue) > BEHIND:
                self._queue.clear()
                self._greet = True
            while len(self._queue) > QUEUED:
                oldest = next((i for i, one in enumerate(self._queue) if not one[2]), 0)
                del self._queue[oldest]
        self._wake()

    def end(self) -> None:
        self._over = True
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # its loop is closed: nobody is there
            self._loop.call_soon_threadsafe(self._some.set)

    async def next(self) -> str | None:
        """All that waits, in the form of the protocol; None when it is over."""
        if self._greet and not self._over:
            assert self._greeting is not None
            self._greet = False  # what is put from here on comes after it
            event, text = await asyncio.to_thread(self._greeting)
            return _form(event, text)
        if not self._over:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._some.wait(), _QUIET_S)
        self._some.clear()
        with self._lock:
            waiting, self._queue = self._queue, deque()
        if self._over:
            return None
        return "".join(_form(event, text) for event, text, _ in waiting) or ": still here\n\n"


def _form(event: str, text: str) -> str:
    return f"event: {event}\ndata: {text}\n\n"


def application(page: str, stream: EventStream, command: Command | None = None, more: Sequence[Route] = ()) -> Starlette:
    """``/`` is the asset ``page``, ``/assets/NAME`` every other, ``/events`` the stream, ``/command`` for JSON objects.

    ``more``: what else this page answers.  A command is answered 204; 400 with one line if ``command`` raises ValueError.
    """

    async def asset(request: Request) -> Response:
        name = request.path_params.get("name", page)
        kind = _KINDS.get(name.rpartition(".")[2])
        if kind is None or name not in {file.name for file in _ASSETS.iterdir()}:
            return PlainTextResponse("no such page", 404)
        return Response((_ASSETS / name).read_bytes(), media_type=kind)

    async def commanded(request: Request) -> Response:
        assert command is not None
        try:
            await asyncio.to_thread(command, _parsed(await _body(request)))
        except ValueError as error:
            return JSONResponse({"error": str(error)}, 400)
        return Response(status_code=204)

    routes = [Route("/", asset), Route("/assets/{name}", asset), Route("/events", stream.respond)]
    return Starlette(routes=[*routes, *more] + ([Route("/command", commanded, methods=["POST"])] if command else []))


async def _body(request: Request) -> bytes:
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "a command is application/json")
    body = b""
    try:
        async for chunk in request.stream():
            body += chunk
            if len(body) > BODY:
                raise HTTPException(413, f"a command has at most {BODY} bytes")
    except ClientDisconnect:
        raise HTTPException(400, "the command broke off") from None
    return body


def _parsed(body: bytes) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no number")

    try:
        value = json.loads(body, parse_constant=refuse)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except UnicodeDecodeError:
        raise ValueError("not UTF-8") from None
    if not isinstance(value, dict):
        raise ValueError("a command is one JSON object")
    return value


class _Guard:
    """Only names of this server are answered, only the page's own commands are taken; headers for every answer."""

    def __init__(self, app: ASGIApp, host: str) -> None:
        self._app = app
        self._names = _HOME | {host.lower(), socket.gethostname().lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in _HEADERS.items())]
            await send(message)

        refused = self._refused({k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}, scope["method"])
        answer = PlainTextResponse(refused, 403) if refused else self._app
        await answer(scope, receive, secured)

    def _refused(self, headers: Mapping[str, str], method: str) -> str | None:
        """Why not: a foreign site that had its own name point here (DNS rebinding), or that sends commands."""
        host = headers.get("host", "").lower()
        name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
        if name not in self._names and not _address(name):
            return f"host {name[:80]!r} is not a name of this server: use its IP address, or start it with --host"
        origin = headers.get("origin")
        foreign = headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none")
        if method not in ("GET", "HEAD") and ((origin is not None and origin.lower() != f"http://{host}") or foreign):
            return f"origin {(origin or '?')[:80]!r}: commands are taken from this server's own page only"
        return None


def _address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def serving(app: Starlette, stream: EventStream, host: str, port: int) -> Iterator[str]:
    """Serve in a thread meanwhile; gives the URL.  Port 0 takes a free one.

    Raises ConfigError if it cannot listen there.
    """
    bound = _bind(host, port)
    # No signal handlers: uvicorn leaves them alone outside the main thread.
    config = uvicorn.Config(
        _Guard(app, host),
        loop="asyncio",
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=4 * VIEWERS,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, name="page", daemon=True)
    thread.start()
    try:
        while not server.started and thread.is_alive():
            time.sleep(0.01)
        named = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        yield f"http://{f'[{named}]' if ':' in named else named}:{bound.getsockname()[1]}/"
    finally:
        stream.close()
        server.should_exit = True
        thread.join(10.0)
        bound.close()


def _bind(host: str, port: int) -> socket.socket:
    if not 0 <= port <= 65535:
        raise ConfigError(f"--web {port}: a port is 0 (any free one) to 65535")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        bound = socket.socket(family, socket.SOCK_STREAM)
    except OSError as error:
        raise ConfigError(f"--host {host}: {error.strerror or error}; name an address of this machine") from None
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen(128)
    except OSError as error:
        bound.close()
        raise ConfigError(
            f"cannot listen on {host}, port {port}: {(error.strerror or str(error)).lower()}; "
            "name another port, or --web 0 for any free one"
        ) from None
    return bound
