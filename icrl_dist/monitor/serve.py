"""HTTP server of the live view's pages: it runs in a thread, sends events to viewers and accepts their commands.

One process serves one page.  A page loads nothing from other servers and has no inline script,
and only the page itself may send a command.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import resources
from typing import Any, Protocol

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from icrl_dist.config.run import ConfigError
from icrl_dist.monitor.event_stream import MAX_VIEWERS

MAX_BODY = 4096
"""Bytes of a command."""
_LOCAL_NAMES = {"127.0.0.1", "localhost", "::1"}
_ASSETS = resources.files("icrl_dist.monitor") / "assets"
_MEDIA_TYPES = {
    "css": "text/css",
    "html": "text/html",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "LICENSE": "text/plain",
}
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
"""Executes a viewer's command, a JSON object, on a thread of the server.  Raises ValueError with a line for the viewer."""


class Events(Protocol):
    """What ``/events`` answers with: an EventStream, or several of them."""

    async def respond(self, request: Request) -> Response:
        """The endpoint."""
        ...

    def close(self) -> None:
        """End every stream and accept no more viewers."""
        ...


def application(page: str, stream: Events, command: Command | None = None, routes: Sequence[Route] = ()) -> Starlette:
    """The application of one page.

    ``/`` is the asset ``page``, ``/assets/NAME`` any asset, ``/events`` the stream; ``/command`` takes JSON objects
    and answers 204, or 400 with one line if ``command`` raises ValueError.  ``routes``: further routes.
    """

    async def asset(request: Request) -> Response:
        name = request.path_params.get("name", page)
        media_type = _MEDIA_TYPES.get(name.rpartition(".")[2])
        if media_type is None or name not in {file.name for file in _ASSETS.iterdir()}:
            return PlainTextResponse("no such file", 404)
        return Response((_ASSETS / name).read_bytes(), media_type=media_type)

    async def execute(request: Request) -> Response:
        assert command is not None
        try:
            await asyncio.to_thread(command, _parse(await _body(request)))
        except ValueError as error:
            return JSONResponse({"error": str(error)}, 400)
        return Response(status_code=204)

    common = [Route("/", asset), Route("/assets/{name}", asset), Route("/events", stream.respond)]
    commands = [Route("/command", execute, methods=["POST"])] if command else []
    return Starlette(routes=[*common, *routes, *commands])


async def _body(request: Request) -> bytes:
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "a command must have the content type application/json")
    body = b""
    try:
        async for chunk in request.stream():
            body += chunk
            if len(body) > MAX_BODY:
                raise HTTPException(413, f"a command may have at most {MAX_BODY} bytes")
    except ClientDisconnect:
        raise HTTPException(400, "the connection closed before the end of the command") from None
    return body


def _parse(body: bytes) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not a finite number")

    try:
        value = json.loads(body, parse_constant=refuse)
    except RecursionError:
        raise ValueError("the command is nested too deeply") from None
    except UnicodeDecodeError:
        raise ValueError("the command is not UTF-8") from None
    if not isinstance(value, dict):
        raise ValueError("a command must be one JSON object")
    return value


class _Guard:
    """Middleware: refuses foreign host names and commands from foreign pages, and adds security headers to every response."""

    def __init__(self, app: ASGIApp, host: str) -> None:
        self._app = app
        self._host_names = _LOCAL_NAMES | {host.lower(), socket.gethostname().lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in _HEADERS.items())]
            await send(message)

        refusal = self._refusal({k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}, scope["method"])
        respond = PlainTextResponse(refusal, 403) if refusal else self._app
        await respond(scope, receive, secured)

    def _refusal(self, headers: Mapping[str, str], method: str) -> str | None:
        """Why a request is refused: its host name is foreign (DNS rebinding), or it is a command from a foreign page."""
        host = headers.get("host", "").lower()
        name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]
        if name not in self._host_names and not _is_address(name):
            return f"host {name[:80]!r} is not a name of this server: use its IP address, or start the server with --host"
        origin = headers.get("origin")
        foreign = headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none")
        if method not in ("GET", "HEAD") and ((origin is not None and origin.lower() != f"http://{host}") or foreign):
            return f"origin {(origin or '?')[:80]!r}: only this server's own page may send commands"
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def serving(app: Starlette, stream: Events, host: str, port: int) -> Iterator[str]:
    """Context manager: serves ``app`` in a thread and yields the URL.  Port 0 selects a free port.

    Raises ConfigError if the address or the port cannot be used.
    """
    bound = _bind(host, port)
    # Outside the main thread uvicorn installs no signal handlers.
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
        limit_concurrency=4 * MAX_VIEWERS,
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
        raise ConfigError(f"--web {port}: a port must be 0 (any free port) to 65535")
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
            "name another port, or --web 0 for any free port"
        ) from None
    return bound
