"""Endpoints, ``PROTOCOL/HOST:PORT``, at which a learner listens or is reached, and which of them are allowed."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from dataclasses import dataclass

HELP = "docs/security.md"
_FORM = re.compile(r"([a-z]+)/(\[[^\]]+\]|[^:\[\]/?#\s]+):(\d{1,5})([?#][^\n]*)?")


@dataclass(frozen=True)
class Endpoint:
    """The parts of an endpoint, without Zenoh's options after the port."""

    protocol: str
    host: str
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this node can reach it.  A host name other than ``localhost`` counts as another node."""
        address = _address(self.host)
        return self.host == "localhost" if address is None else address.is_loopback

    @property
    def everywhere(self) -> bool:
        """Whether it means every address of this node (``0.0.0.0``); such an address cannot be connected to."""
        address = _address(self.host)
        return address is not None and address.is_unspecified


def parse(endpoint: str) -> Endpoint:
    """Split an endpoint; IPv6 addresses stand in brackets, as in ``tls/[::1]:0``.  Raises ValueError for another form."""
    found = _FORM.fullmatch(endpoint)
    if found is None or int(found[3]) > 65535:
        raise ValueError("write it as tcp/127.0.0.1:PORT, or as tls/HOST:PORT with stream.certificates")
    return Endpoint(found[1], found[2].strip("[]"), int(found[3]))


def objections(endpoint: str, connect: str, certificates: str) -> Iterator[tuple[str, str, str]]:
    """What is not allowed in ``stream.endpoint`` and ``stream.connect``: the name, its value, the remedy.

    Without certificates only loopback addresses of this node are allowed; with certificates only
    TLS.  If ``connect`` is empty, workers connect to ``endpoint``.
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
        return "" if where.protocol == "tls" else "stream.certificates is set: write it as tls/HOST:PORT, or unset that"
    if where.protocol == "tls":
        return f"TLS needs stream.certificates, a folder: see {HELP}"
    if not where.loopback:
        return f"unencrypted only on this node, as tcp/127.0.0.1:0; otherwise tls/HOST:PORT and stream.certificates: see {HELP}"
    return ""


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
