"""Simulated cluster nodes on this machine, for tests: each has its own address, home, /tmp and ssh server.

A node is a process with its own namespaces.  Its network, mounts and processes end with that process.
The process reads a pipe from the test, so it ends when the test ends for any reason.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
HOME = "/run/home"
"""Home folder of a node, as a path on the node."""
PATH = f"{sys.prefix}/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
CODE = f"PYTHONPATH={ROOT}"
"""Makes every node run this checkout and not the package installed in the environment."""
NEEDED = ("openssl", "ip", "unshare", "nsenter", "ssh", "ssh-keygen", "/usr/sbin/sshd", "rsync")

INIT = """
set -eu
files=$1 name=$2
shift 2
mount -t proc proc /proc
mount -t tmpfs tmpfs /run
mkdir -p /run/sshd /run/home
mount --bind "$files/home" /run/home
mount --bind "$files/passwd" /etc/passwd
mount --bind "$files/shadow" /etc/shadow
cp "$files/sshd_config" "$files/host_key" /run/sshd
for folder; do mkdir -p "/run/kept$folder"; mount --rbind "$folder" "/run/kept$folder"; done
mount -t tmpfs tmpfs /dev/shm
mount -t tmpfs tmpfs /tmp
for folder; do mkdir -p "$folder"; mount --rbind "/run/kept$folder" "$folder"; done
hostname "$name"
ip link set lo up
/usr/sbin/sshd -f /run/sshd/sshd_config
echo ready
read -r _ || true
"""

SSHD = """
HostKey /run/sshd/host_key
PidFile /run/sshd/sshd.pid
PermitRootLogin prohibit-password
UsePAM no
UseDNS no
"""


def missing() -> str:
    """Why simulated nodes are impossible on this machine; empty if they are possible."""
    if os.geteuid() != 0:
        return "namespaces with networks need root"
    absent = [name for name in NEEDED if shutil.which(name) is None]
    if absent:
        return f"not installed: {', '.join(absent)} (Debian: apt-get install openssh-server rsync iproute2)"
    trial = subprocess.run(
        ["unshare", "--net", "--mount", "--pid", "--uts", "--ipc", "--fork", "mount", "-t", "proc", "proc", "/proc"],
        capture_output=True,
        text=True,
    )
    return f"no namespaces on this machine: {trial.stderr.strip()}" if trial.returncode else ""


@dataclass(frozen=True)
class SimulatedNode:
    """A running node."""

    name: str
    address: str
    home: Path
    """Home folder as a path on this machine; on the node it is ``HOME``."""
    init: psutil.Process
    """First process of the node; all others descend from it."""

    def command(self, *arguments: object) -> list[str]:
        """The command that runs ``arguments`` on the node, as root with the tests' environment first on PATH."""
        enter = ["nsenter", "-t", str(self.init.pid), "-m", "-p", "-u", "-i", "-n"]
        return [*enter, "env", "-i", f"HOME={HOME}", "USER=root", f"PATH={PATH}", CODE, *map(str, arguments)]

    def run(self, *arguments: object, timeout: float = 90) -> str:
        """Run a command on the node; returns its output.  Raises AssertionError with the output if it fails."""
        done = subprocess.run(
            self.command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout
        )
        assert done.returncode == 0, f"{' '.join(map(str, arguments))} on {self.name}:\n{done.stdout}"
        return done.stdout

    def processes(self, word: str) -> list[psutil.Process]:
        """The processes of the node with ``word`` in their command line."""
        found = []
        for process in self.init.children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                if word in " ".join(process.cmdline()):
                    found.append(process)
        return found


@contextlib.contextmanager
def running(folder: Path, names: Sequence[str]) -> Iterator[list[SimulatedNode]]:
    """Start nodes on one network; they reach each other by ssh with the key ``~/.ssh/id_ed25519`` of each."""
    key = folder / "key"
    for name in ("key", "host_key"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name], check=True)
    with contextlib.ExitStack() as stack:
        nodes = [stack.enter_context(_node(folder / name, name, f"10.0.0.{n}", key)) for n, name in enumerate(names, 1)]
        _connect(nodes)
        yield nodes


@contextlib.contextmanager
def _node(files: Path, name: str, address: str, key: Path) -> Iterator[SimulatedNode]:
    (files / "home" / ".ssh").mkdir(parents=True, mode=0o700)
    (files / "home").chmod(0o700)
    shutil.copy(key, files / "home" / ".ssh" / "id_ed25519")
    shutil.copy(key.with_suffix(".pub"), files / "home" / ".ssh" / "authorized_keys")
    shutil.copy(key.with_name("host_key"), files)
    (files / "sshd_config").write_text(SSHD)
    (files / "passwd").write_text(f"root:x:0:0::{HOME}:/bin/bash\nsshd:x:100:65534::/run/sshd:/usr/sbin/nologin\n")
    (files / "shadow").write_text("root:*:19000:0:99999:7:::\nsshd:*:19000:0:99999:7:::\n")
    apart = ["unshare", "--net", "--mount", "--pid", "--uts", "--ipc", "--fork", "--kill-child"]
    kept = dict.fromkeys(map(str, (ROOT, sys.prefix, sys.base_prefix)))
    with subprocess.Popen(
        [*apart, "bash", "-c", INIT, "init", files, name, *kept], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n", f"{name} did not start"
            (init,) = psutil.Process(process.pid).children()
            yield SimulatedNode(name, address, files / "home", init)
        finally:
            process.stdin.close()
            process.wait(timeout=20)


def _connect(nodes: Sequence[SimulatedNode]) -> None:
    """Create a bridge on the first node and a virtual cable from it to each other node."""
    first, *others = nodes
    first.run("ip", "link", "add", "bridge", "type", "bridge")
    for number, node in enumerate(others):
        ends = (f"port{number}", "netns", first.init.pid, "type", "veth", "peer", "name", "eth0", "netns", node.init.pid)
        subprocess.run(["ip", "link", "add", "name", *map(str, ends)], check=True)
        first.run("ip", "link", "set", f"port{number}", "master", "bridge", "up")
    for node, device in ((first, "bridge"), *((node, "eth0") for node in others)):
        node.run("ip", "address", "add", f"{node.address}/24", "dev", device)
        node.run("ip", "link", "set", device, "up")
