"""What one machine of a cluster says of itself, and whether it reaches another: asked of every one before a run."""

from __future__ import annotations

import contextlib
import os
import platform
import resource
import shutil
import socket
import ssl
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import icrl_dist
from icrl_dist.stream import security
from icrl_dist.stream.link import LinkError
from icrl_dist.version import digest as code_digest

VERSIONS = ("ray", "torch", "eclipse-zenoh", "numpy", "msgpack")
REACH_S = 3.0
"""A port that has not answered after so long is not reached."""


@dataclass(frozen=True)
class Facts:
    """A machine, as a run needs to know it."""

    host: str
    python: str
    version: str
    code: str
    """``code_digest()`` of what it would run."""
    versions: dict[str, str]
    time: float
    """Its clock, seconds since 1970."""
    cores: int
    shared_memory: int
    """Free bytes in /dev/shm; 0 if there is none."""
    open_files: int
    """How many it may have open at once."""
    certificates: str
    """What is wrong with its certificates; empty if nothing is, or if none are needed."""
    unreached: tuple[str, ...]
    """Why it does not reach each of the ports that it was asked about and does not reach."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def facts(certificates: str = "", ports: Sequence[tuple[str, int]] = ()) -> dict[str, Any]:
    """This machine's ``Facts``, as a dictionary: another version of this package may read it.

    ``certificates``: their folder, of which the worker's are looked at; ``ports``: hosts and ports
    that it needs, where somebody listens now.
    """
    shm = Path("/dev/shm")
    return Facts(
        host=socket.gethostname(),
        python=platform.python_version(),
        version=icrl_dist.__version__,
        code=code_digest(),
        versions={name: _version(name) for name in VERSIONS},
        time=time.time(),
        cores=len(os.sched_getaffinity(0)),
        shared_memory=shutil.disk_usage(shm).free if shm.is_dir() else 0,
        open_files=resource.getrlimit(resource.RLIMIT_NOFILE)[0],
        certificates=_certificates(certificates),
        unreached=tuple(filter(None, (reach(*port) for port in ports))),
    ).as_dict()


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "none"


def _certificates(folder: str) -> str:
    try:
        security.files(folder, "worker")
    except (LinkError, ssl.SSLError) as error:
        return str(error)
    return ""


def reach(host: str, port: int, timeout_s: float = REACH_S) -> str:
    """Why nothing is reached there from here; empty if something is."""
    try:
        with socket.create_connection((host, port), timeout=timeout_s):
            return ""
    except OSError as error:
        return f"{host}:{port}: {error}"


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[int]:
    """Somebody to reach: a port of this machine that takes connections and says nothing; yields its number.

    Raises OSError if it cannot be bound.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=256) as server:
        yield int(server.getsockname()[1])


def differences(here: dict[str, Any], there: dict[str, Any]) -> list[str]:
    """What another machine has otherwise than this one and a run cannot bear, in words: ``torch 2.8 there, 2.9 here``."""
    found = []
    minor = [str(one["python"]).rsplit(".", 1)[0] for one in (here, there)]
    if minor[0] != minor[1]:
        found.append(f"Python {there['python']} there, {here['python']} here")
    if there["version"] != here["version"]:
        found.append(f"icrl-dist {there['version']} there, {here['version']} here")
    elif there["code"] != here["code"]:
        found.append(f"icrl-dist's code {there['code'][:8]} there, {here['code'][:8]} here")
    for name, mine in here["versions"].items():
        theirs = there["versions"].get(name, "none")
        if theirs != mine:
            found.append(f"{name} {theirs} there, {mine} here")
    return found
