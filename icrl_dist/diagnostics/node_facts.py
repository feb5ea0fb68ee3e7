"""Facts about one node of a cluster, collected on every node before a run, and the comparison of two nodes."""

from __future__ import annotations

import contextlib
import os
import platform
import resource
import shutil
import socket
import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import icrl_dist
from icrl_dist.config import plugins
from icrl_dist.models.compiled import Unusable, library
from icrl_dist.stream import security
from icrl_dist.stream.link import LinkError
from icrl_dist.version import digest as code_digest

VERSIONS = ("ray", "torch", "eclipse-zenoh", "numpy", "msgpack")
REACH_S = 3.0
"""Seconds after which a port that has not answered counts as unreachable."""


@dataclass(frozen=True)
class Facts:
    """Properties of a node that a run depends on."""

    host: str
    python: str
    version: str
    code: str
    """``version.digest()`` of its code."""
    versions: dict[str, str]
    plugins: dict[str, list[str]]
    """Distribution, version and code digest of problems and methods of other packages: ``plugins.sources``."""
    time: float
    """Its clock, in seconds since 1970."""
    cores: int
    shared_memory: int
    """Free bytes in /dev/shm; 0 if it does not exist."""
    open_files: int
    """Limit of open files."""
    certificates: str
    """The error of its certificates; empty if they are valid or not needed."""
    unreached: tuple[str, ...]
    """One error message for each requested port that it cannot reach."""
    decoder: str
    """Why it cannot use the compiled decoder, with the remedy; empty if it can."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def facts(certificates: str = "", ports: Sequence[tuple[str, int]] = ()) -> dict[str, Any]:
    """The ``Facts`` of this machine, as a dictionary, because another version of this package may read it.

    ``certificates``: the folder in which the worker's certificates are checked.  ``ports``: hosts and
    ports that this machine must reach, where a socket listens now.
    """
    shm = Path("/dev/shm")
    return Facts(
        host=socket.gethostname(),
        python=platform.python_version(),
        version=icrl_dist.__version__,
        code=code_digest(),
        versions={name: _version(name) for name in VERSIONS},
        plugins={name: list(source) for name, source in plugins.sources().items()},
        time=time.time(),
        cores=len(os.sched_getaffinity(0)),
        shared_memory=shutil.disk_usage(shm).free if shm.is_dir() else 0,
        open_files=resource.getrlimit(resource.RLIMIT_NOFILE)[0],
        certificates=_certificates(certificates),
        unreached=tuple(filter(None, (reach(*port) for port in ports))),
        decoder=str(built) if isinstance(built := library("decoder"), Unusable) else "",
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
    """Try to connect.  Returns the error message, or an empty string if the connection succeeds."""
    try:
        with socket.create_connection((host, port), timeout=timeout_s):
            return ""
    except OSError as error:
        return f"{host}:{port}: {error}"


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[int]:
    """Accept connections at a port of this machine, for nodes that test whether they reach it; yields its number.

    Raises OSError if the port cannot be bound.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=256) as server:
        yield int(server.getsockname()[1])


def differences(here: dict[str, Any], there: dict[str, Any], needed: Mapping[str, str] | None = None) -> list[str]:
    """Differences of another node from this machine that a run does not allow, such as ``torch 2.8 there, 2.9 here``.

    ``needed``: the problem and the method of the run, from ``plugins.of_run``; other packages may differ in others.
    """
    found = []
    minor = [str(facts["python"]).rsplit(".", 1)[0] for facts in (here, there)]
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
    for name, what in (needed or {}).items():
        ours, other = here["plugins"].get(name), there.get("plugins", {}).get(name)
        if ours != other:
            found.append(f"{what}: {plugins.text(other)} there, {plugins.text(ours)} here")
    return found
