"""Missing nodes: the nodes that a cluster file promises and that have not joined, with the errors in Ray's logs."""

from __future__ import annotations

import functools
import logging
import re
import socket
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

_log = logging.getLogger(__name__)

BOOTSTRAP = Path("~/ray_bootstrap_config.yaml")
"""The cluster file that `ray up` copied to the head node."""
LOGS = Path("/tmp/ray/session_latest/logs")
_LINES = 3
"""Lines of the logs in a report."""


@dataclass(frozen=True)
class ExpectedNodes:
    """The nodes that the cluster file promises, without the head."""

    addresses: tuple[str, ...] = ()
    """Addresses or names of the nodes that the file lists."""
    count: int = 0
    """Minimum number of nodes, listed or not."""


def expected(bootstrap: Path | None = None) -> ExpectedNodes:
    """Read the cluster file that this head node was started with; no nodes if there is none."""
    file = bootstrap or BOOTSTRAP
    try:
        file = file.expanduser()
        config = yaml.safe_load(file.read_text())
        provider = config["provider"]
        if provider.get("type") == "local":
            addresses = tuple(map(str, provider.get("worker_ips") or ()))
            return ExpectedNodes(addresses, len(addresses))
        kinds = config.get("available_node_types") or {}
        head = config.get("head_node_type")
        return ExpectedNodes((), sum(int(kind.get("min_workers") or 0) for name, kind in kinds.items() if name != head))
    except (FileNotFoundError, RuntimeError):  # or this user has no home folder
        return ExpectedNodes()
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError) as error:
        _log.warning("%s is not a cluster file: %s", file, error)
        return ExpectedNodes()


def report(nodes: ExpectedNodes, joined: Collection[str], logs: Path | None = None) -> list[str]:
    """One line per expected node whose address is not in ``joined``, with the last lines of the logs about it."""
    absent = [address for address in nodes.addresses if not {address, *_resolved(address)} & set(joined)]
    if nodes.addresses:
        return [f"{address} has not joined: {_log_lines(logs or LOGS, address)}" for address in absent]
    lacking = nodes.count - len(joined)
    if lacking <= 0:
        return []
    return [f"{lacking} of {nodes.count} nodes have not joined: {_log_lines(logs or LOGS, '')}"]


@functools.lru_cache
def _resolved(name: str) -> frozenset[str]:
    """The IP addresses of a name in a cluster file; Ray reports its nodes by IP address."""
    try:
        return frozenset(str(found[4][0]) for found in socket.getaddrinfo(name, None))
    except OSError:
        return frozenset()


def _log_lines(logs: Path, address: str) -> str:
    """The last lines of the autoscaler's logs about an address, or the last errors if ``address`` is empty."""
    lines: list[str] = []
    for name in ("monitor.log", "monitor.out", "monitor.err"):
        try:
            lines += (logs / name).read_text(errors="replace").splitlines()
        except OSError:
            continue
    found = _about(lines, address) if address else [line for line in lines if re.search(r"rror|ailed|denied|refused", line)]
    return " | ".join(found[-_LINES:]) or f"Ray's log does not mention it (`ray monitor`, {logs}/monitor.*)"


def _about(lines: Sequence[str], address: str) -> list[str]:
    """The lines that contain the address, only the errors among them if there are any; each once, in order."""
    whole = re.compile(rf"(?<![\d.]){re.escape(address)}(?![\d.]*\d)")
    found = dict.fromkeys(line.strip()[:200] for line in lines if whole.search(line))
    errors = [line for line in found if re.search(r"rror|ailed|denied|refused|timed out|unreachable|No route", line)]
    return errors or list(found)
