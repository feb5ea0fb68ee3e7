"""The doctor's checks with faults: a port in use, a folder that cannot be written, old libraries."""

from __future__ import annotations

import os
import resource
import shutil
import socket
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from icrl_dist.diagnostics import doctor
from icrl_dist.diagnostics.checks import Check, table
from icrl_dist.diagnostics.doctor import LIBRARIES, diagnose

FREE = "tcp/127.0.0.1:0"


def check_named(name: str, endpoint: str = FREE, folder: Path = Path()) -> Check:
    (check,) = [f for f in diagnose(endpoint, folder) if f.name == name]
    return check


@pytest.mark.usefixtures("no_ray_token")
def test_checks_that_pass_on_every_machine_with_these_tests(tmp_path: Path) -> None:
    checks = {f.name: f for f in diagnose(FREE, tmp_path / "runs" / "new")}
    for name in ("Python", *LIBRARIES, "stream endpoint", "loopback", "run folder", "home", "Ray token", "GPU"):
        assert checks[name].ok is True, checks[name]
    assert list(tmp_path.iterdir()) == [], "the doctor left a file behind"
    for check in checks.values():
        assert (check.ok is True) == (check.remedy == ""), check
    assert metadata.version("numpy") in checks["numpy"].value


def test_a_port_in_use_fails() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        in_use = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        check = check_named("stream endpoint", in_use)
        assert check.ok is False
        assert in_use in check.value
        assert "port 0" in check.remedy
    assert check_named("stream endpoint", in_use).ok is True


@pytest.mark.parametrize(
    "endpoint", ["127.0.0.1:0", "tcp/127.0.0.1", "tcp/127.0.0.1:x", "tcp/127.0.0.1:99999", "tcp/:0", "tcp/192.0.2.1:0", ""]
)
def test_an_endpoint_that_cannot_be_bound(endpoint: str) -> None:
    assert check_named("stream endpoint", endpoint).ok is False


def test_udp_and_tcp_ports_with_the_same_number_are_distinct() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", number))
        assert check_named("stream endpoint", f"udp/127.0.0.1:{number}").ok is False
        assert check_named("stream endpoint", f"tcp/127.0.0.1:{number}").ok is True


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """Its parent is a file, so even root cannot create it."""
    (tmp_path / "file").write_text("")
    inside = tmp_path / "file" / "runs"
    check = check_named("run folder", folder=inside)
    assert check.ok is False
    assert str(inside) in check.value
    assert "--out" in check.remedy


def test_a_home_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert check_named("home").ok is None


def test_a_library_too_old_and_one_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "msgpack":
            raise metadata.PackageNotFoundError(name)
        return "1.0.9" if name == "eclipse-zenoh" else real(name)

    real = metadata.version
    monkeypatch.setattr(metadata, "version", version)
    old, missing, good = check_named("eclipse-zenoh"), check_named("msgpack"), check_named("torch")
    assert (old.ok, missing.ok, good.ok) == (False, False, True)
    assert "1.0.9 (needs >=" in old.value
    assert old.remedy.startswith("pip install 'eclipse-zenoh>=")
    assert missing.value.startswith("not installed")


def test_a_python_outside_the_declared_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 10, 4))
    check = check_named("Python")
    assert check.ok is False
    assert check.value.startswith("3.10.4 (needs >=3.11)")


@pytest.mark.parametrize(("gib", "ok"), [(8, True), (1.5, None), (0.5, False)])
def test_memory_and_disk_depend_on_the_free_bytes(gib: float, ok: bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    free = int(gib * doctor.GIB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=free))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free))
    assert check_named("memory").ok is ok
    assert check_named("disk").ok is ok
    assert f"{gib:.1f} GiB" in check_named("disk").value


def test_shared_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._shared_memory(tmp_path / "none").ok is None
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=64 << 20))
    check = doctor._shared_memory(tmp_path)
    assert check.ok is None
    assert "--shm-size" in check.remedy


def test_few_cores_and_few_files_are_warnings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    monkeypatch.setattr(resource, "getrlimit", lambda which: (256, 1024))
    assert check_named("cores").ok is None
    files = check_named("open files")
    assert files.ok is None
    assert "256" in files.value
    assert "ulimit" in files.remedy


@pytest.mark.usefixtures("no_ray_token")
def test_ray_token_is_required_in_token_mode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    assert check_named("Ray token").ok is False
    assert check_named("Ray token").remedy
    (tmp_path / ".ray").mkdir()
    token = tmp_path / ".ray" / "auth_token"
    token.write_text("\n")
    assert check_named("Ray token").ok is False, "an empty file is no token"
    token.write_text("secret-of-this-test")
    token.chmod(0o644)
    check = check_named("Ray token")
    assert check.ok is None and check.remedy == f"chmod 600 {token}"
    token.chmod(0o600)
    check = check_named("Ray token")
    assert check.ok is True
    assert "secret-of-this-test" not in table([check])


def test_table_has_one_line_per_check_with_its_remedy() -> None:
    lines = table(
        [Check("a", True, "fine"), Check("long name", False, "broken\nbadly", "repair it"), Check("b", None, "so")]
    ).split("\n")
    assert len(lines) == 3
    assert lines[0].split() == ["ok", "a", "fine"]
    assert lines[1].startswith("FAIL")
    assert "broken badly" in lines[1]
    assert lines[1].endswith("-> repair it")
    assert lines[2].startswith("warn")
    assert "->" not in lines[0] + lines[2]
