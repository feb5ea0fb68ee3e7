"""Where a stream listens or is reached, as ``PROTOCOL/HOST:PORT``; and which of them are safe."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from dataclasses import dataclass

HELP = "docs/security.md"
_FORM = re.compile(r"([a-z]+)/(\[[^\]]+\]|[^:\[\]/?#\s]+):(\d{1,5})([?#][^\n]*)?")


@dataclass(frozen=True)
class Endpoint:
    """An endpoint taken apart; what Zenoh may find after the port is left out."""

    protocol: str
    host: str
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it.  A name other than ``localhost`` is taken to be elsewhere."""
        address = _address(self.host)
        return self.host == "localhost" if address is None else address.is_loopback

    @property
    def everywhere(self) -> bool:
        """Whether it stands for every address of this machine, so that nobody can connect to it by that name."""
        address = _address(self.host)
        return address is not None and address.is_unspecified


def parse(endpoint: str) -> Endpoint:
    """The endpoint's parts.  IPv6 addresses stand in brackets, as in ``tls/[::1]:0``.  Raises ValueError if it is none."""
    found = _FORM.fullmatch(endpoint)
    if found is None or int(found[3]) > 65535:
        raise ValueError("write it as tcp/127.0.0.1:PORT, or as tls/HOST:PORT with stream.certificates")
    return Endpoint(found[1], found[2].strip("[]"), int(found[3]))


def objections(endpoint: str, connect: str, certificates: str) -> Iterator[tuple[str, str, str]]:
    """What speaks against where a learner listens and is reached: which of the two, its value, the remedy.

    In the clear only on this machine; with certificates always by TLS.  ``connect`` may be
    empty: workers then connect to ``endpoint``.
    """
    for name, value in (("endpoint", endpoint), ("connect", connect or endpoint)):
        remedy = _objection(value, bool(certificates))
        if remedy:
            yield name, value, remedy
            return
    reached = parse(connect or endpoint)
    if reached.everywhere or (connect and not reached.port):
        yield "connect", connect, f"name one address and port at which workers reach {endpoint}, as tls/HOST:PORT"


def _objection(endpoint: str, certificates: bool) -> str:
    try:
        where = parse(endpoint)
    except ValueError as error:
        return str(error)
    if certificates:
        return "" if where.protocol == "tls" else "stream.certificates is set: write it as tls/HOST:PORT, or leave those out"
    if where.protocol == "tls":
        return f"TLS needs stream.certificates, a folder: see {HELP}"
    if not where.loopback:
        return f"in the clear only on this machine, as tcp/127.0.0.1:0; else tls/HOST:PORT and stream.certificates: see {HELP}"
    return ""


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
