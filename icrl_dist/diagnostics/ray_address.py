"""The address of a Ray cluster: whether a cluster answers there, before Ray itself tries for minutes."""

from __future__ import annotations

import os
import socket

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics.node_facts import REACH_S

_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
"""What a client of HTTP/2, and so of Ray's gRPC, sends first: the preface and an empty SETTINGS frame."""
_SETTINGS = 4
"""Type of the frame that the server answers with; it is the fourth byte of a frame."""
_REMEDY = (
    "name the head as HOST:PORT (its port is 6379 unless `ray start --port` set another), or start a cluster with `ray up`"
)


def require_cluster(address: str) -> None:
    """Raise ConfigError, within seconds, unless a Ray cluster may answer at ``address`` (HOST:PORT or ``auto``).

    Ray repeats its attempts for a quarter of an hour, and Ctrl-C does not reach them.  ``auto`` without RAY_ADDRESS is not
    tried: Ray then looks for a cluster among the processes of this machine, which takes a moment.
    """
    option, place = f"--address {address or repr(address)}", address
    if address == "auto" and (place := os.environ.get("RAY_ADDRESS", "")):
        option += f" (RAY_ADDRESS={place})"
    if address == "auto" and place in ("", "auto"):
        return
    if place == "local":
        raise ConfigError(f"{option}: names no cluster; leave --address out to start Ray on this machine")
    host, _, port = place.rpartition(":")
    if "://" in place or not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ConfigError(f"{option}: is no address of a cluster; {_REMEDY}")
    if error := _no_answer(host.strip("[]"), int(port)):
        raise ConfigError(
            f"{option}: no Ray cluster answers there ({error}); `ray status` on the head shows its state; {_REMEDY}"
        )


def _no_answer(host: str, port: int) -> str:
    """What prevents a gRPC server at a port from answering; empty if one does."""
    try:
        with socket.create_connection((host, port), timeout=REACH_S) as connection:
            if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
                return ""
            connection.sendall(_PREFACE)
            answer = b""
            while len(answer) < _SETTINGS and (more := connection.recv(64)):
                answer += more
    except TimeoutError:
        return f"no answer within {REACH_S:.0f} s"
    except (OSError, UnicodeError) as error:
        return str(getattr(error, "strerror", None) or error)
    return "" if answer[3:4] == bytes([_SETTINGS]) else "another program listens there"
