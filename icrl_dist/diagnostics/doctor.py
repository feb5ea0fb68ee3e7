"""Checks whether this machine, a cluster file or a running cluster can run a training."""

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
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import cluster_file, cluster_nodes, node_facts, ray_job, surroundings
from icrl_dist.diagnostics.checks import Check
from icrl_dist.diagnostics.modules import check_modules
from icrl_dist.diagnostics.ray_address import require_cluster
from icrl_dist.diagnostics.ray_token import check_ray_token, require_ray_token
from icrl_dist.diagnostics.surroundings import existing, writable
from icrl_dist.models.compiled import Unusable, kinds, library
from icrl_dist.stream import endpoints

LIBRARIES = ("torch", "ray", "eclipse-zenoh", "msgpack", "gymnasium", "numpy")
GIB = 1 << 30


def diagnose(endpoint: str, folder: Path) -> list[Check]:
    """Checks of this machine: versions, resources, the stream's ``endpoint``, the parent ``folder`` of run folders."""
    return [
        _python(),
        *_libraries(),
        check_modules(),
        _cores(),
        _memory(),
        _endpoint(endpoint),
        _loopback(),
        writable("run folder", folder, "choose another with --out, or make it writable"),
        surroundings.check_locks(folder),
        _disk(folder),
        *surroundings.checks(),
        _shared_memory(Path("/dev/shm")),
        _open_files(),
        check_ray_token(),
        _compiled("decoder", "torch computes decisions, which takes several times as long"),
        _compiled("training", "torch fits models, and digests are equal on machines of one kind only"),
        _gpu(),
    ]


def _python() -> Check:
    have = ".".join(map(str, sys.version_info[:3]))
    wanted = metadata.metadata("icrl-dist")["Requires-Python"]
    ok = SpecifierSet(wanted).contains(have)
    return Check("Python", ok, f"{have} (needs {wanted})", "" if ok else f"make a venv with Python {wanted}")


def _libraries() -> Iterator[Check]:
    required = {r.name: r for r in map(Requirement, metadata.requires("icrl-dist") or ())}
    for name in LIBRARIES:
        wanted = required[name].specifier
        try:
            installed = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Check(name, False, f"not installed (needs {wanted})", f"pip install '{required[name]}'")
            continue
        ok = wanted.contains(installed, prereleases=True)
        yield Check(name, ok, f"{installed} (needs {wanted})", "" if ok else f"pip install '{required[name]}'")


def _cores() -> Check:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    enough = True if count >= 2 else None
    return Check(
        "cores",
        enough,
        str(count),
        "" if enough else "nothing must be done: one worker starts, and shares the core with the learner",
    )


def _memory() -> Check:
    free = float(psutil.virtual_memory().available)
    for limit, used in (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")):
        group = Path("/sys/fs/cgroup")
        try:
            free = min(free, int((group / limit).read_text()) - int((group / used).read_text()))
        except (OSError, ValueError):  # no such control group, or "max"
            continue
    ok = True if free >= 2 * GIB else None if free >= GIB else False
    return Check(
        "memory", ok, f"{free / GIB:.1f} GiB free", "" if ok else "free some memory: a run with two workers needs about 2 GiB"
    )


def _endpoint(endpoint: str) -> Check:
    name = "stream endpoint"
    # Zenoh's format: PROTOCOL/HOST:PORT, an IPv6 host in brackets, then ?metadata or #config.
    match = re.fullmatch(r"(tcp|tls|udp|quic)/(\[[^\]]+\]|[^:\[\]]+):(\d+)([?#].*)?", endpoint)
    if match is None or int(match[3]) > 65535:
        return Check(name, False, endpoint, "write it as tcp/HOST:PORT; port 0 chooses a free port")
    kind = socket.SOCK_DGRAM if match[1] in ("udp", "quic") else socket.SOCK_STREAM
    try:
        family, _, _, _, address = socket.getaddrinfo(match[2].strip("[]"), int(match[3]), type=kind)[0]
        with socket.socket(family, kind) as probe:
            if kind == socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            if kind == socket.SOCK_STREAM:
                probe.listen()
    except OSError as error:
        return Check(name, False, f"{endpoint}: {error}", "choose this machine's address and a free port, or port 0")
    return Check(name, True, f"{endpoint} can be bound")


def _loopback() -> Check:
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            server.settimeout(2)
            with socket.create_connection(server.getsockname(), timeout=2) as client, server.accept()[0] as accepted:
                client.sendall(b"ping")
                accepted.settimeout(2)
                ok = accepted.recv(4) == b"ping"
    except OSError as error:
        return Check("loopback", False, f"127.0.0.1: {error}", "bring it up: ip link set lo up")
    return Check(
        "loopback", ok, "127.0.0.1 answers" if ok else "127.0.0.1 changes the data", "" if ok else "look for a proxy on lo"
    )


def _disk(folder: Path) -> Check:
    free = shutil.disk_usage(existing(folder)).free
    ok = True if free >= 5 * GIB else None if free >= GIB else False
    return Check(
        "disk", ok, f"{free / GIB:.1f} GiB free", "" if ok else "free some space: the datasets of long runs take gigabytes"
    )


def _shared_memory(mount: Path) -> Check:
    name = "shared memory"
    remedy = "give the container --shm-size=2g, or Ray's object store falls back to the disk"
    if not mount.is_dir():
        return Check(name, None, f"no {mount}", remedy)
    free = shutil.disk_usage(mount).free
    ok = True if free >= 0.5 * GIB else None
    return Check(name, ok, f"{free / GIB:.1f} GiB free in {mount}", "" if ok else remedy)


def _open_files() -> Check:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    ok = True if soft >= 4096 or soft == resource.RLIM_INFINITY else None
    return Check("open files", ok, f"at most {soft} (hard limit {hard})", "" if ok else "ulimit -n 65536 before starting Ray")


def _compiled(kernel: str, without: str) -> Check:
    """Whether a compiled kernel can be used here, the name of the check; ``without``: what torch does in its place."""
    if isinstance(why := library(kernel), Unusable):
        return Check(f"{kernel} kernel", None, f"{why.why}: {without}", why.remedy)
    return Check(f"{kernel} kernel", True, f"compiled, for {' and '.join(kinds(kernel))}")


def _gpu() -> Check:
    import torch

    if not torch.cuda.is_available():
        return Check("GPU", True, "torch finds none: the learner trains on the CPU")
    count = torch.cuda.device_count()
    return Check("GPU", True, f"{count} x {torch.cuda.get_device_name(0)}")


def diagnose_file(file: Path, root: Path) -> list[Check]:
    """Offline checks of a cluster file: Ray's schema first, then ours.  Raises ConfigError if it is no cluster file."""
    config = cluster_file.load(file)
    ray = _ray_accepts(config)
    return [ray, *(cluster_file.check_file(config, root) if ray.ok else ())]


def _ray_accepts(config: dict[str, Any]) -> Check:
    from jsonschema import ValidationError
    from ray.autoscaler._private.util import prepare_config, validate_config

    try:
        with contextlib.redirect_stdout(
            io.StringIO()
        ):  # Ray prints a warning about mounted files, which matters only for Docker
            validate_config(prepare_config(copy.deepcopy(config)))
    except ValidationError as error:
        where = ".".join(map(str, error.absolute_path)) or "the file"
        return Check("Ray's schema", False, f"{where}: {error.message}", "correct it: docs.ray.io, cluster YAML configuration")
    except Exception as error:  # Ray passes on every error of its providers, even AttributeError
        return Check("Ray's schema", False, f"{type(error).__name__}: {error}", "compare it with the files in deploy/clusters/")
    return Check("Ray's schema", True, "accepted")


def diagnose_cluster(address: str, endpoint: str, certificates: str) -> list[Check]:
    """Checks of a running cluster, through Ray: every node's versions, clock, shared memory, certificates and ports.

    ``endpoint``: where the learner would listen on this machine, which must be the head.  Raises
    ConfigError if the cluster does not answer, or if ``endpoint`` is not valid.
    """
    import ray as module

    ray: Any = module
    try:
        parsed = endpoints.parse(endpoint)
    except ValueError as error:
        raise ConfigError(f"--endpoint {endpoint}: {error}") from None
    require_ray_token(address)
    require_cluster(address)
    try:
        ray.init(address=address, job_config=ray_job.job_config(ray), log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, ray.exceptions.AuthenticationError) as error:
        raise ConfigError(
            f"--address {address}: {error}; `ray status` on the head shows whether a cluster is running"
        ) from None
    try:
        with _listening(parsed, endpoint, len([node for node in ray.nodes() if node["Alive"]])) as (learner, checks):
            return [*checks, *cluster_nodes.check_nodes(ray, learner, certificates)]
    finally:
        ray.shutdown()


@contextlib.contextmanager
def _listening(
    parsed: endpoints.Endpoint, endpoint: str, count: int
) -> Iterator[tuple[tuple[str, int] | None, tuple[Check, ...]]]:
    """Listen at the learner's endpoint, so that every node can try to connect to it.

    Yields its host and port, or None if the nodes must not try it, and the checks of the endpoint.
    """
    name = "stream endpoint"
    if parsed.loopback and count > 1:
        remedy = "give the endpoint of the learner, such as --endpoint tls/HEAD_IP:7447"
        yield None, (Check(name, None, f"{endpoint} can be reached from this machine only, so no other node tries it", remedy),)
        return
    with contextlib.ExitStack() as stack:
        try:
            port = stack.enter_context(node_facts.listening(parsed.host, parsed.port))
        except OSError as error:
            in_use = error.errno == errno.EADDRINUSE  # then nodes can try to connect to the present owner
            remedy = "wait for the active run, or choose a free port" if in_use else "choose an address of the head"
            check = Check(name, None if in_use else False, f"{endpoint}: {error.strerror or error}", remedy)
            yield (parsed.host, parsed.port) if in_use else None, (check,)
        else:
            yield (parsed.host, port), ()
