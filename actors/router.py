"""A router for the workers of one node: ``python -P -m actors.router``.

The workers connect to the router, and only the router connects to the learner.  In clusters of hundreds
of workers the learner then has one connection per node, not one per worker.  The environment variable
``ICRL_ROUTER`` of Ray's worker processes contains the address of the router.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Mapping

from icrl_dist.stream import endpoints, security
from icrl_dist.stream.link import LinkError
from icrl_dist.stream.zenoh_link import ZenohLink

VARIABLE = "ICRL_ROUTER"
"""Environment variable: the address on which the router of this node listens, such as tcp/127.0.0.1:7448."""


def connection(endpoint: str, certificates: str) -> tuple[str, Mapping[str, object]]:
    """Address and settings with which a worker connects to the learner at ``endpoint``: those of the router, if there is one.

    Raises LinkError for a router on another node, because that connection has no TLS, or for invalid certificates.
    """
    router = os.environ.get(VARIABLE, "")
    if not router:
        return endpoint, security.client(certificates, "worker")
    _check_loopback(router, VARIABLE)
    return router, {}


def run(listen: str, connect: str, certificates: str, timeout_s: float = 60.0) -> ZenohLink:
    """Start a router; it runs until the returned link is closed, and reconnects to the learner by itself.

    Raises LinkError if the learner does not answer at ``connect`` within ``timeout_s``, or if ``listen`` is not a
    loopback address.
    """
    _check_loopback(listen, "--listen")
    # A peer routes for its clients like a router.  In Zenoh's mode "router" the learner's access rules would
    # also have to allow declarations that no worker needs (subscriptions to liveliness).
    settings = {"mode": "peer", "listen/endpoints": [listen], **security.client(certificates, "worker")}
    return ZenohLink.connect(connect, timeout_s, settings)


def _check_loopback(endpoint: str, name: str) -> None:
    try:
        loopback = endpoints.parse(endpoint).loopback
    except ValueError as error:
        raise LinkError(f"{name} = {endpoint!r}: {error}") from None
    if not loopback:
        raise LinkError(f"{name} = {endpoint!r}: a router must listen on a loopback address, such as tcp/127.0.0.1:7448")


def main() -> int:
    """Run a router until SIGINT or SIGTERM; returns exit code 2 and prints one line if it cannot start."""
    parser = argparse.ArgumentParser(prog="python -P -m actors.router", description=__doc__)
    parser.add_argument("--connect", required=True, help="address of the learner, such as tls/HEAD:7447")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7448", help="loopback address on which the router listens")
    parser.add_argument("--certificates", default="", help="folder with ca.pem, worker.pem and worker.key")
    parser.add_argument("--timeout", type=float, default=1e6, help="seconds to wait for the learner")
    arguments = parser.parse_args()
    ended = threading.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: ended.set())
    try:
        with run(arguments.listen, arguments.connect, arguments.certificates, arguments.timeout):
            ended.wait()
    except LinkError as error:
        print(f"router: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
