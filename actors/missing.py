"""Which machines a cluster should have and has not, and what its log says of them."""

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
"""The cluster file as `ray up` left it on the head."""
LOGS = Path("/tmp/ray/session_latest/logs")
_TAIL = 3


@dataclass(frozen=True)
class Expected:
    """What the cluster file promises beside the head."""

    addresses: tuple[str, ...] = ()
    """Of machines that are named in it."""
    count: int = 0
    """How many workers there will be at least, named or not."""


def expected(bootstrap: Path | None = None) -> Expected:
    """By the cluster file that this head was started with; nothing if there is none."""
    file = (bootstrap or BOOTSTRAP).expanduser()
    try:
        config = yaml.safe_load(file.read_text())
        provider = config["provider"]
        if provider.get("type") == "local":
            named = tuple(map(str, provider.get("worker_ips") or ()))
            return Expected(named, len(named))
        kinds = config.get("available_node_types") or {}
        return Expected((), sum(int(k.get("min_workers") or 0) for n, k in kinds.items() if n != config.get("head_node_type")))
    except FileNotFoundError:
        return Expected()
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError) as error:
        _log.warning("%s is no cluster file: %s", file, error)
        return Expected()


def report(promised: Expected, here: Collection[str], logs: Path | None = None) -> list[str]:
    """A line for each machine that is not among the addresses ``here``: which, and the end of what the log says of it."""
    absent = [address for address in promised.addresses if not {address, *_resolved(address)} & set(here)]
    if promised.addresses:
        return [f"{address} has not joined: {_said(logs or LOGS, address)}" for address in absent]
    lacking = promised.count - len(here)
    return [f"{lacking} of {promised.count} machines have not joined: {_said(logs or LOGS, '')}"] if lacking > 0 else []


@functools.lru_cache
def _resolved(name: str) -> frozenset[str]:
    """The addresses that a name in a cluster file stands for, as Ray's machines go by theirs."""
    try:
        return frozenset(str(found[4][0]) for found in socket.getaddrinfo(name, None))
    except OSError:
        return frozenset()


def _said(logs: Path, address: str) -> str:
    """The last words of the autoscaler's logs about an address, or at all."""
    lines: list[str] = []
    for name in ("monitor.log", "monitor.out", "monitor.err"):
        try:
            lines += (logs / name).read_text(errors="replace").splitlines()
        except OSError:
            continue
    found = _about(lines, address) if address else [line for line in lines if re.search(r"rror|ailed|denied|refused", line)]
    return " | ".join(found[-_TAIL:]) or f"its log says nothing of it (`ray monitor`, {logs}/monitor.*)"


def _about(lines: Sequence[str], address: str) -> list[str]:
    """Lines that name the address, and what follows them where that is an error; each once, in order."""
    whole = re.compile(rf"(?<![\d.]){re.escape(address)}(?![\d.]*\d)")
    said = dict.fromkeys(line.strip()[:200] for line in lines if whole.search(line))
    troubled = [line for line in said if re.search(r"rror|ailed|denied|refused|timed out|unreachable|No route", line)]
    return troubled or list(said)
