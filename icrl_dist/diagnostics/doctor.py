"""Is this machine fit for a run?  One finding a question, each with its remedy."""

from __future__ import annotations

import contextlib
import copy
import errno
import io
import logging
import os
import re
import resource
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import cluster_file, cluster_nodes, node_facts
from icrl_dist.diagnostics.checks import Finding, table
from icrl_dist.stream import endpoints

LIBRARIES = ("torch", "ray", "eclipse-zenoh", "msgpack", "gymnasium", "numpy")
GIB = 1 << 30

__all__ = ["Finding", "diagnose", "diagnose_cluster", "diagnose_file", "need_ray_token", "table"]


def diagnose(endpoint: str, folder: Path) -> list[Finding]:
    """Everything a run needs: versions, machine, the stream's ``endpoint``, the run ``folder``."""
    return [
        _python(),
        *_libraries(),
        _cores(),
        _memory(),
        _endpoint(endpoint),
        _loopback(),
        _writable("run folder", folder, "choose another with --out, or make it writable"),
        _disk(folder),
        _writable("home", Path.home(), "set HOME to a folder you may write to: Ray and torch keep files there"),
        _shared_memory(Path("/dev/shm")),
        _open_files(),
        _ray_token(),
        _gpu(),
    ]


def _python() -> Finding:
    have = ".".join(map(str, sys.version_info[:3]))
    wanted = metadata.metadata("icrl-dist")["Requires-Python"]
    ok = SpecifierSet(wanted).contains(have)
    return Finding("Python", ok, f"{have} (needs {wanted})", "" if ok else f"make a venv with Python {wanted}")


def _libraries() -> Iterator[Finding]:
    required = {r.name: r for r in map(Requirement, metadata.requires("icrl-dist") or ())}
    for name in LIBRARIES:
        wanted = required[name].specifier
        try:
            have = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Finding(name, False, f"not installed (needs {wanted})", f"pip install '{required[name]}'")
            continue
        ok = wanted.contains(have, prereleases=True)
        yield Finding(name, ok, f"{have} (needs {wanted})", "" if ok else f"pip install '{required[name]}'")


def _cores() -> Finding:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    enough = True if count >= 2 else None
    return Finding("cores", enough, str(count), "" if enough else "use --actors 1: learner and worker will take turns")


def _memory() -> Finding:
    free = float(psutil.virtual_memory().available)
    for limit, used in (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")):
        group = Path("/sys/fs/cgroup")
        try:
            free = min(free, int((group / limit).read_text()) - int((group / used).read_text()))
        except (OSError, ValueError):  # no such control group, or "max"
            continue
    ok = True if free >= 2 * GIB else None if free >= GIB else False
    return Finding(
        "memory", ok, f"{free / GIB:.1f} GiB free", "" if ok else "free some: a run with two workers takes about 2 GiB"
    )


def _endpoint(endpoint: str) -> Finding:
    name = "stream endpoint"
    # What Zenoh understands: PROTOCOL/HOST:PORT, an IPv6 host in brackets, then ?metadata or #config.
    match = re.fullmatch(r"(tcp|tls|udp|quic)/(\[[^\]]+\]|[^:\[\]]+):(\d+)([?#].*)?", endpoint)
    if match is None or int(match[3]) > 65535:
        return Finding(name, False, endpoint, "write it as tcp/HOST:PORT, and port 0 for any free one")
    kind = socket.SOCK_DGRAM if match[1] in ("udp", "quic") else socket.SOCK_STREAM
    try:
        family, _, _, _, address = socket.getaddrinfo(match[2].strip("[]"), int(match[3]), type=kind)[0]
        with socket.socket(family, kind) as trial:
            if kind == socket.SOCK_STREAM:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
            if kind == socket.SOCK_STREAM:
                trial.listen()
    except OSError as error:
        return Finding(name, False, f"{endpoint}: {error}", "choose this machine's address and a free port, or port 0")
    return Finding(name, True, f"{endpoint} can be bound")


def _loopback() -> Finding:
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            server.settimeout(2)
            with socket.create_connection(server.getsockname(), timeout=2) as there, server.accept()[0] as here:
                there.sendall(b"ping")
                here.settimeout(2)
                ok = here.recv(4) == b"ping"
    except OSError as error:
        return Finding("loopback", False, f"127.0.0.1: {error}", "bring it up: ip link set lo up")
    return Finding("loopback", ok, "127.0.0.1 answers" if ok else "127.0.0.1 garbles", "" if ok else "look for a proxy on lo")


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that there is."""
    folder = folder.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder


def _writable(name: str, folder: Path, remedy: str) -> Finding:
    try:
        # Written where the folder would be made; a permission bit would not say it (root, read-only mounts).
        with tempfile.TemporaryFile(dir=_existing(folder)):
            pass
    except OSError as error:
        return Finding(name, False, f"{folder}: {error.strerror or error}", remedy)
    return Finding(name, True, f"{folder} is writable")


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(_existing(folder)).free
    ok = True if free >= 5 * GIB else None if free >= GIB else False
    return Finding("disk", ok, f"{free / GIB:.1f} GiB free", "" if ok else "free some: datasets of long runs take gigabytes")


def _shared_memory(mount: Path) -> Finding:
    name = "shared memory"
    remedy = "give the container --shm-size=2g, or Ray's object store falls back to the disk"
    if not mount.is_dir():
        return Finding(name, None, f"no {mount}", remedy)
    free = shutil.disk_usage(mount).free
    ok = True if free >= 0.5 * GIB else None
    return Finding(name, ok, f"{free / GIB:.1f} GiB free in {mount}", "" if ok else remedy)


def _open_files() -> Finding:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    ok = True if soft >= 4096 or soft == resource.RLIM_INFINITY else None
    return Finding("open files", ok, f"at most {soft} (hard limit {hard})", "" if ok else "ulimit -n 65536 before starting Ray")


def _ray_token() -> Finding:
    """Ray 2.60 refuses every connection without a token where authentication is on."""
    mode = os.environ.get("RAY_AUTH_MODE", "disabled")
    if mode != "token":
        return Finding("Ray token", True, f"not needed (RAY_AUTH_MODE is {mode})")
    if os.environ.get("RAY_AUTH_TOKEN"):
        return Finding("Ray token", True, "in RAY_AUTH_TOKEN")
    file = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    try:
        ok = bool(file.read_text().strip())
    except OSError:
        ok = False
    return Finding("Ray token", ok, f"in {file}" if ok else f"none in {file}", "" if ok else "ray get-auth-token --generate")


def need_ray_token(address: str) -> None:
    """Raises ConfigError unless this process shows the Ray cluster at ``address`` a token.

    Ray turns that on by itself only for clusters that it starts; an address given never does.
    """
    finding = _ray_token()
    if os.environ.get("RAY_AUTH_MODE") != "token" or not finding.ok:
        raise ConfigError(
            f"--address {address}: without a token anyone who reaches Ray's ports can run code there "
            f"(Ray token: {finding.value}); make one with `ray get-auth-token --generate`, copy it to every node, "
            "and set RAY_AUTH_MODE=token there and here"
        )


def _gpu() -> Finding:
    import torch

    if not torch.cuda.is_available():
        return Finding("GPU", True, "none seen by torch: the learner fits on the CPU")
    count = torch.cuda.device_count()
    return Finding("GPU", True, f"{count} x {torch.cuda.get_device_name(0)}")


def diagnose_file(file: Path, root: Path) -> list[Finding]:
    """A cluster file, offline: Ray's own opinion of it, then ours.  Raises ConfigError if it is none."""
    config = cluster_file.load(file)
    ray = _ray_accepts(config)
    return [ray, *(cluster_file.findings(config, root) if ray.ok else ())]


def _ray_accepts(config: dict[str, Any]) -> Finding:
    from jsonschema import ValidationError
    from ray.autoscaler._private.util import prepare_config, validate_config

    try:
        with contextlib.redirect_stdout(io.StringIO()):  # Ray warns of mounts that are files, which concerns Docker only
            validate_config(prepare_config(copy.deepcopy(config)))
    except ValidationError as error:
        where = ".".join(map(str, error.absolute_path)) or "the file"
        return Finding(
            "Ray's schema", False, f"{where}: {error.message}", "correct it: docs.ray.io, cluster YAML configuration"
        )
    except Exception as error:  # Ray raises whatever its providers do, down to AttributeError
        return Finding(
            "Ray's schema", False, f"{type(error).__name__}: {error}", "compare it with the files in deploy/clusters/"
        )
    return Finding("Ray's schema", True, "accepted")


def diagnose_cluster(address: str, endpoint: str, certificates: str) -> list[Finding]:
    """A live cluster, asked through Ray: every machine's versions, clock, shared memory, certificates and the ports it needs.

    ``endpoint``: where the learner would listen on this machine, which is taken to be the head.
    Raises ConfigError if the cluster does not answer, or if that is no endpoint.
    """
    import ray as module

    ray: Any = module
    try:
        where = endpoints.parse(endpoint)
    except ValueError as error:
        raise ConfigError(f"--endpoint {endpoint}: {error}") from None
    need_ray_token(address)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ray.exceptions.AuthenticationError) as error:
        raise ConfigError(f"--address {address}: {error}; `ray status` there says whether a cluster is up") from None
    try:
        with _reachable(where, endpoint, len([node for node in ray.nodes() if node["Alive"]])) as (learner, findings):
            return [*findings, *cluster_nodes.examine(ray, learner, certificates)]
    finally:
        ray.shutdown()


@contextlib.contextmanager
def _reachable(
    where: endpoints.Endpoint, endpoint: str, count: int
) -> Iterator[tuple[tuple[str, int] | None, tuple[Finding, ...]]]:
    """Host and port where somebody listens now, None if machines are not to try that; and what there is to say of it."""
    name = "stream endpoint"
    if where.loopback and count > 1:
        remedy = "say where the learner will listen, as in --endpoint tls/HEAD_IP:7447"
        yield None, (Finding(name, None, f"{endpoint} is this machine's alone, so no other tries to reach it", remedy),)
        return
    with contextlib.ExitStack() as stack:
        try:
            port = stack.enter_context(node_facts.listening(where.host, where.port))
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE  # by whom a machine can try to reach as well
            remedy = "wait for the run that is on, or choose a free port" if taken else "choose an address of the head"
            found = Finding(name, None if taken else False, f"{endpoint}: {error.strerror or error}", remedy)
            yield (where.host, where.port) if taken else None, (found,)
        else:
            yield (where.host, port), ()
