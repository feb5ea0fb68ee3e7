"""The HTTP server of the metrics for Prometheus: one thread and one connection at a time, so that no client can use up more."""

from __future__ import annotations

import socket
import threading
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

_PATIENCE_S = 2.0
"""Seconds that a client may take for its next bytes."""


class _Handler(WSGIRequestHandler):
    timeout = _PATIENCE_S

    def log_message(self, *_: object) -> None:
        """Requests are not logged."""


class _Server(WSGIServer):
    def server_bind(self) -> None:
        """As in ``WSGIServer``, without a look-up of this machine's name, which may take seconds."""
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]
        self.setup_environ()


class MetricsServer:
    """Serves a registry at HOST:PORT until ``close``.  Raises OSError if that port cannot be used."""

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        server = type("_FamilyServer", (_Server,), {"address_family": family})
        self._server: WSGIServer = server(address[:2], _Handler)
        self._server.set_app(make_wsgi_app(registry))
        self._thread = threading.Thread(target=self._server.serve_forever, name="prometheus", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return self._server.server_port

    def close(self) -> None:
        """Wait at most ``_PATIENCE_S`` for a client that is slow."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(2 * _PATIENCE_S)
