"""Limits on the connections to a process that listens: strangers cannot use up its descriptors, its sessions or its port.

Zenoh accepts every TCP connection, keeps it for ten seconds without a handshake, and stops accepting for ever once the
process has no descriptor left.  So a thread counts the connections that are not a session yet.  Beyond a limit it closes
the port for new ones (a socket filter drops their first packet, and the client's kernel sends it again) until old ones
have timed out.  What this cannot do, such as limits by address, a firewall can: docs/security.md.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import resource
import select
import socket
import stat
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

from icrl_dist.stream.dispatch import Dispatcher

_log = logging.getLogger(__name__)

MAX_PENDING = 128
"""Connections that are not a session yet; beyond them the port is closed for new ones."""
MAX_MONITORS = 64
"""Sessions with a monitor's certificate; a further one is ended."""
MAX_SESSIONS = 4096
"""Sessions of all clients, where the limit on descriptors allows so many."""
_MOST_DESCRIPTORS = 1 << 16
_RESERVE = 1024
"""Descriptors that only the process's own files can use, once the port is closed."""
_OPEN_S, _CLOSED_S, _PAUSE_S = 1.0, 0.05, 0.002
_ATTACH_FILTER, _DETACH_FILTER = 26, 27
_DROP_ALL = ctypes.create_string_buffer(struct.pack("HBBI", 6, 0, 0, 0))
"""The classic BPF program ``ret 0``."""
_OPEN = Path("/proc/self/fd")


class Descriptors:
    """The limit on this process's descriptors: raised as far as it may be, less a reserve."""

    def __init__(self) -> None:
        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._hard = hard
        self._most = _MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _MOST_DESCRIPTORS)
        self._reserve = min(_RESERVE, self._most // 4)
        self.usable = self._most - 2 * self._reserve
        """Open descriptors beyond which the port is closed."""
        self.hold_reserve()

    @property
    def sessions(self) -> int:
        """The limit on sessions, each of which has a descriptor."""
        return min(MAX_SESSIONS, self.usable * 3 // 4)

    def hold_reserve(self) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (self._most - self._reserve, self._hard))

    def release_reserve(self) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (self._most, self._hard))


class Admission:
    """Watches the connections to one port of this process, from a thread of its own, until ``close``."""

    def __init__(self, port: int, descriptors: Descriptors) -> None:
        self._port, self._descriptors = port, descriptors
        self._lock = threading.Lock()
        self._sessions: dict[str, str | None] = {}
        """The role of each session, by the peer's address."""
        self._listeners = [one for one in _sockets() if _listens(one, port)]
        for listener in self._listeners:
            listener.listen(MAX_PENDING // 2)  # connections that Zenoh could still accept after the port is closed
        self.closed = False
        """Whether the port is closed for new connections."""
        self._ended = threading.Event()
        self._dispatcher = Dispatcher("admission")
        self._thread = threading.Thread(target=self._watch, name="connections", daemon=True)
        self._thread.start()

    def session(self, begins: bool, role: str | None, peer: str) -> None:
        """A session with the peer at this address (``HOST:PORT``) begins or has ended; ``role``: of its certificate."""
        with self._lock:
            if not begins:
                self._sessions.pop(peer, None)
                return
            self._sessions[peer] = role
            excess = role == "monitor" and list(self._sessions.values()).count("monitor") > MAX_MONITORS
        if excess:
            _log.warning("a session from %s is ended: %d monitors are connected, the limit", peer, MAX_MONITORS)
            self._dispatcher.post(lambda: self._end(peer))

    def close(self) -> None:
        """Stop watching; must be called before the port can be used again."""
        self._ended.set()
        for listener in self._listeners:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RD)  # wakes the thread
        self._thread.join(5.0)
        self._dispatcher.close()
        for listener in self._listeners:
            listener.close()
        self._descriptors.release_reserve()

    def _watch(self) -> None:
        waiting = select.poll()
        for listener in self._listeners:
            waiting.register(listener, select.POLLIN)
        while not self._ended.wait(_CLOSED_S if self.closed else _PAUSE_S):
            if not self.closed:
                waiting.poll(_OPEN_S * 1000)
            try:
                self._look()
            except OSError as error:
                _log.warning("the connections to port %d cannot be counted or limited: %s", self._port, error)
                self._ended.wait(_OPEN_S)

    def _look(self) -> None:
        """Close the port if there are too many connections or descriptors, open it if there are few again."""
        used = _descriptors()
        share = 0.5 if self.closed else 1.0
        full = used > self._descriptors.usable * (0.5 + share / 2)
        with self._lock:
            maybe_pending = used - len(self._sessions)
        if not full and maybe_pending > MAX_PENDING * share:
            full = self._pending() > MAX_PENDING * share
        if full == self.closed:
            return
        self._set_filter(full)
        self.closed = full
        (self._descriptors.release_reserve if full else self._descriptors.hold_reserve)()
        _log.warning("port %d is %s new connections", self._port, "closed for" if full else "open again for")

    def _set_filter(self, drop: bool) -> None:
        program = struct.pack("HP", 1, ctypes.addressof(_DROP_ALL))
        for listener in self._listeners:
            if drop:
                listener.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, program)
            else:
                with contextlib.suppress(FileNotFoundError):  # the same socket is in the list twice
                    listener.setsockopt(socket.SOL_SOCKET, _DETACH_FILTER, 0)

    def _pending(self) -> int:
        """The number of connections to the port that are not a session."""
        connections = sum(1 for _ in self._connections())
        with self._lock:
            return connections - len(self._sessions)

    def _end(self, peer: str) -> None:
        for connection, found in self._connections():
            if found == peer:
                with contextlib.suppress(OSError):  # it has ended
                    connection.shutdown(socket.SHUT_RDWR)  # Zenoh then ends the session

    def _connections(self) -> Iterator[tuple[socket.socket, str]]:
        """The connections to the port, with the peer's address as Zenoh writes it."""
        for one in _sockets():
            with one, contextlib.suppress(OSError):
                if one.family in (socket.AF_INET, socket.AF_INET6) and one.getsockname()[1] == self._port:
                    host, port = one.getpeername()[:2]
                    yield one, f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _descriptors() -> int:
    return sum(1 for _ in _OPEN.iterdir())


def _sockets() -> Iterator[socket.socket]:
    """The sockets of this process, each as a duplicate that its user closes."""
    for entry in _OPEN.iterdir():
        with contextlib.suppress(OSError):  # it is closed by now
            if stat.S_ISSOCK(os.fstat(int(entry.name)).st_mode):
                yield socket.socket(fileno=os.dup(int(entry.name)))


def _listens(one: socket.socket, port: int) -> bool:
    try:
        if one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) and one.getsockname()[1] == port:
            return True
    except (OSError, IndexError):
        pass
    one.close()
    return False
