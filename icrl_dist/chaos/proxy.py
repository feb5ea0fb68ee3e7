"""A TCP proxy that can stop forwarding, like a cut cable: no data passes and no connection is closed."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

_CHUNK = 1 << 16
_POLL_S = 0.1


class Proxy:
    """Forwards every connection to ``target()``, in both directions, except while it is cut."""

    def __init__(self, target: Callable[[], tuple[str, int] | None]) -> None:
        """Listens on a free port of 127.0.0.1.

        ``target`` returns host and port for each new connection; None closes the connection.
        """
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.forwarded = 0
        """Bytes forwarded so far."""
        self._forwarding = threading.Event()
        self._forwarding.set()
        self._closed = False
        self._sockets: set[socket.socket] = set()
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, name="proxy", daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._closed = True
        self._forwarding.set()
        with self._lock:
            for one in (*self._sockets, self._listener):
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
                one.close()

    def cut(self) -> None:
        """Stop forwarding and accepting connections; open connections stay open."""
        self._forwarding.clear()

    def mend(self) -> None:
        """Forward again, first the data that was held back."""
        self._forwarding.set()

    def _accept(self) -> None:
        while not self._closed:
            self._forwarding.wait()
            try:
                if not select.select([self._listener], [], [], _POLL_S)[0] or not self._forwarding.is_set():
                    continue
                near, _ = self._listener.accept()
            except (OSError, ValueError):  # the proxy was closed
                return
            threading.Thread(target=self._join, args=(near,), name="proxy connection", daemon=True).start()

    def _join(self, near: socket.socket) -> None:
        target = self._target()
        try:
            if target is None:
                raise ConnectionRefusedError
            far = socket.create_connection(target, timeout=5.0)
        except OSError:
            near.close()
            return
        far.settimeout(None)
        with self._lock:
            self._sockets |= {near, far}
        ways = [threading.Thread(target=self._pump, args=way, daemon=True) for way in ((near, far), (far, near))]
        for way in ways:
            way.start()
        for way in ways:
            way.join()
        with self._lock:
            self._sockets -= {near, far}
        near.close()
        far.close()

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        """Forward one direction of a connection until one end closes; then close the other."""
        with contextlib.suppress(OSError):
            while content := source.recv(_CHUNK):
                self._forwarding.wait()
                target.sendall(content)
                self.forwarded += len(content)
        self._forwarding.wait()
        for one in (source, target):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
