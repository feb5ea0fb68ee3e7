"""A router for one machine's workers: ``python -m actors.router``.  They connect to it, it alone to the learner.

For clusters of hundreds of workers: the learner then holds a connection a machine, not one a
worker.  ``ICRL_ROUTER`` in the environment of Ray's worker processes names it to them.
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
"""Environment variable: where the router of this machine listens, such as tcp/127.0.0.1:7448."""


def reached(endpoint: str, certificates: str) -> tuple[str, Mapping[str, object]]:
    """Where a worker here reaches the learner at ``endpoint``, and with which settings: through the router, if any.

    Raises LinkError for a router on another machine, which nothing would guard, or for certificates that are none.
    """
    router = os.environ.get(VARIABLE, "")
    if not router:
        return endpoint, security.client(certificates, "worker")
    _only_here(router, VARIABLE)
    return router, {}


def run(listen: str, connect: str, certificates: str, timeout_s: float = 60.0) -> ZenohLink:
    """The router, until it is closed.  It finds the learner again by itself.

    Raises LinkError if nobody answers at ``connect`` within ``timeout_s``, or if ``listen`` is not on this machine.
    """
    _only_here(listen, "--listen")
    # A peer routes for its clients as a router does; Zenoh's mode "router" would also have the learner's
    # rules let out declarations that no worker needs (who watches liveliness).
    settings = {"mode": "peer", "listen/endpoints": [listen], **security.client(certificates, "worker")}
    return ZenohLink.connect(connect, timeout_s, settings)


def _only_here(endpoint: str, what: str) -> None:
    try:
        here = endpoints.parse(endpoint).loopback
    except ValueError as error:
        raise LinkError(f"{what} = {endpoint!r}: {error}") from None
    if not here:
        raise LinkError(f"{what} = {endpoint!r}: nothing guards a router off this machine; write it as tcp/127.0.0.1:7448")


def main() -> int:
    """Run a router until it is told to end; exit code 2 with one line if it cannot."""
    parser = argparse.ArgumentParser(prog="python -m actors.router", description=__doc__)
    parser.add_argument("--connect", required=True, help="the learner, as tls/HEAD:7447")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7448", help="where this machine's workers find the router")
    parser.add_argument("--certificates", default="", help="folder with ca.pem, worker.pem and worker.key")
    parser.add_argument("--timeout", type=float, default=1e6, help="seconds to wait for the learner")
    given = parser.parse_args()
    over = threading.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: over.set())
    try:
        with run(given.listen, given.connect, given.certificates, given.timeout):
            over.wait()
    except LinkError as error:
        print(f"router: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
