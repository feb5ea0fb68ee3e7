"""``--address``: one line within seconds if no cluster answers there, for every command that takes an address."""

import contextlib
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time

import pytest

from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import ray_address
from icrl_dist.diagnostics.ray_address import require_cluster


@contextlib.contextmanager
def server(answer):
    """A server at a free port that sends ``answer`` to each client; None: it stays silent."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    client, _ = listener.accept()
                    clients.append(client)
                    if answer is not None:
                        client.sendall(answer)
                        client.shutdown(socket.SHUT_WR)

        clients = list[socket.socket]()
        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
    for client in clients:
        client.close()


def closed_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return f"127.0.0.1:{listener.getsockname()[1]}"


def refusal(address):
    with pytest.raises(ConfigError) as refused:
        require_cluster(address)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("address", ["", "head", "ray://head:10001", "head:", ":6379", "head:0", "head:65536", "head:-1"])
def test_what_is_no_address_is_refused_with_the_remedy(address):
    assert re.match(
        rf"--address {re.escape(address or repr(address))}: is no address of a cluster; name the head as", refusal(address)
    )


def test_local_is_no_cluster():
    assert "leave --address out" in refusal("local")


@pytest.mark.parametrize(
    ("answer", "cause"), [(None, "no answer within 0 s"), (b"SSH-2.0-x\r\n", "another program listens"), (b"", "another")]
)
def test_a_port_where_another_program_listens_is_named(monkeypatch, answer, cause):
    monkeypatch.setattr(ray_address, "REACH_S", 0.3)
    with server(answer) as address:
        assert refusal(address).startswith(f"--address {address}: no Ray cluster answers there ({cause}")


def test_a_server_of_grpc_is_accepted(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "192.0.2.1:1")  # does not count for a given address
    with server(bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))) as address:
        require_cluster(address)


def test_auto_is_the_address_in_the_environment_if_there_is_one(monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    require_cluster("auto")
    address = closed_port()
    monkeypatch.setenv("RAY_ADDRESS", address)
    text = refusal("auto")
    assert text.startswith(f"--address auto (RAY_ADDRESS={address}): no Ray cluster answers there (Connection refused)")


@pytest.mark.integration
@pytest.mark.parametrize("words", [("train", "smoke", "--out", "run"), ("doctor",)])
def test_a_command_with_an_address_where_nothing_listens_ends_within_seconds(monkeypatch, tmp_path, capsys, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "secret")
    began, address = time.monotonic(), closed_port()
    assert main.main([*words, "--address", address]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"--address {address}: no Ray cluster answers there (Connection refused); `ray status`" in line
    assert time.monotonic() - began < 30 and not list(tmp_path.iterdir())


LOCAL_RAY = """
import os, sys, psutil
os.environ["RAY_ADDRESS"] = "192.0.2.1:6379"
from actors import local
from actors.session import Session
from icrl_dist.diagnostics.ray_address import require_cluster
import ray
local.forget_other_clusters()
local.protect_token()
session = Session(ray, print, num_cpus=1, object_store_memory=100 << 20)
assert ray.get(ray.remote(lambda: 7).remote()) == 7
require_cluster(ray.get_runtime_context().gcs_address)
family = [psutil.Process(), *psutil.Process().children(recursive=True)]
print([c.laddr.ip for p in family for c in p.net_connections("tcp") if c.status == psutil.CONN_LISTEN])
gcs = next(p for p in family if p.name() == "gcs_server")
gcs.kill()
while not session.failure():
    pass
print(session.failure())
session.close()
print([p for p in family[1:] if p.is_running() and p.status() != "zombie"], os.listdir(os.environ["RAY_TMPDIR"]))
"""


@pytest.mark.integration
def test_ray_of_a_local_run_listens_on_the_loopback_only_and_leaves_nothing(monkeypatch):
    with tempfile.TemporaryDirectory(dir="/tmp") as base:  # a short path
        monkeypatch.setenv("RAY_TMPDIR", base)
        ran = subprocess.run([sys.executable, "-c", LOCAL_RAY], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    addresses, failure, left = ran.stdout.splitlines()
    found = re.findall(r"'([^']+)'", addresses)
    assert len(found) > 5 and set(found) <= {"127.0.0.1", "::ffff:127.0.0.1"}, addresses
    assert re.fullmatch(r"Ray's process gcs_server \(\d+\) has ended", failure)
    assert left == "[] []" and "Traceback" not in ran.stderr
