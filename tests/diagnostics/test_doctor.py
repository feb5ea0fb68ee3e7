"""The doctor against machines that are ill: a taken port, a folder that cannot be, old libraries."""

from __future__ import annotations

import socket
from collections import namedtuple
from importlib import metadata
from pathlib import Path

import psutil
import pytest

from icrl_dist.diagnostics import doctor
from icrl_dist.diagnostics.doctor import LIBRARIES, Finding, diagnose, table

FREE = "tcp/127.0.0.1:0"


def ask(name: str, endpoint: str = FREE, folder: Path = Path()) -> Finding:
    (finding,) = [f for f in diagnose(endpoint, folder) if f.name == name]
    return finding


@pytest.mark.usefixtures("no_ray_token")
def test_what_holds_on_every_machine_that_runs_these_tests(tmp_path: Path) -> None:
    findings = {f.name: f for f in diagnose(FREE, tmp_path / "runs" / "new")}
    for name in ("Python", *LIBRARIES, "stream endpoint", "loopback", "run folder", "home", "Ray token", "GPU"):
        assert findings[name].ok is True, findings[name]
    assert list(tmp_path.iterdir()) == [], "the doctor left something behind"
    for finding in findings.values():
        assert (finding.ok is True) == (finding.remedy == ""), finding
    assert metadata.version("numpy") in findings["numpy"].value


def test_a_port_in_use_is_found() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        finding = ask("stream endpoint", taken)
        assert finding.ok is False
        assert taken in finding.value
        assert "port 0" in finding.remedy
    assert ask("stream endpoint", taken).ok is True


@pytest.mark.parametrize(
    "endpoint", ["127.0.0.1:0", "tcp/127.0.0.1", "tcp/127.0.0.1:x", "tcp/127.0.0.1:99999", "tcp/:0", "tcp/192.0.2.1:0", ""]
)
def test_an_endpoint_that_cannot_be_bound(endpoint: str) -> None:
    assert ask("stream endpoint", endpoint).ok is False


def test_a_udp_port_is_another_than_the_tcp_port_of_its_number() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", number))
        assert ask("stream endpoint", f"udp/127.0.0.1:{number}").ok is False
        assert ask("stream endpoint", f"tcp/127.0.0.1:{number}").ok is True


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """Its parent is a file, which stops even root."""
    (tmp_path / "file").write_text("")
    inside = tmp_path / "file" / "runs"
    finding = ask("run folder", folder=inside)
    assert finding.ok is False
    assert str(inside) in finding.value
    assert "--out" in finding.remedy


def test_a_home_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert ask("home").ok is False


def test_a_library_too_old_and_one_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "msgpack":
            raise metadata.PackageNotFoundError(name)
        return "1.0.9" if name == "eclipse-zenoh" else real(name)

    real = metadata.version
    monkeypatch.setattr(doctor.metadata, "version", version)
    old, missing, fine = ask("eclipse-zenoh"), ask("msgpack"), ask("torch")
    assert (old.ok, missing.ok, fine.ok) == (False, False, True)
    assert "1.0.9 (needs >=" in old.value
    assert old.remedy.startswith("pip install 'eclipse-zenoh>=")
    assert missing.value.startswith("not installed")


def test_a_python_outside_the_declared_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 4))
    finding = ask("Python")
    assert finding.ok is False
    assert finding.value.startswith("3.10.4 (needs >=3.11)")


@pytest.mark.parametrize(("gib", "ok"), [(8, True), (1.5, None), (0.5, False)])
def test_memory_and_disk_by_what_is_free(gib: float, ok: bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    free = int(gib * doctor.GIB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: namedtuple("Memory", "available")(free))
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: namedtuple("Usage", "free")(free))
    assert ask("memory").ok is ok
    assert ask("disk").ok is ok
    assert f"{gib:.1f} GiB" in ask("disk").value


def test_shared_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._shared_memory(tmp_path / "none").ok is None
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: namedtuple("Usage", "free")(64 << 20))
    finding = doctor._shared_memory(tmp_path)
    assert finding.ok is None
    assert "--shm-size" in finding.remedy


def test_few_cores_and_few_files_are_warnings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.os, "sched_getaffinity", lambda pid: {0})
    monkeypatch.setattr(doctor.resource, "getrlimit", lambda which: (256, 1024))
    assert ask("cores").ok is None
    files = ask("open files")
    assert files.ok is None
    assert "256" in files.value
    assert "ulimit" in files.remedy


@pytest.mark.usefixtures("no_ray_token")
def test_ray_token_is_looked_for_when_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    assert ask("Ray token").ok is False
    assert ask("Ray token").remedy
    (tmp_path / ".ray").mkdir()
    token = tmp_path / ".ray" / "auth_token"
    token.write_text("\n")
    assert ask("Ray token").ok is False, "an empty token is none"
    token.write_text("secret-of-this-test")
    finding = ask("Ray token")
    assert finding.ok is True
    assert "secret-of-this-test" not in table([finding])


def test_table_is_one_line_a_finding_with_its_remedy() -> None:
    lines = table(
        [Finding("a", True, "fine"), Finding("long name", False, "broken\nbadly", "mend it"), Finding("b", None, "so")]
    ).split("\n")
    assert len(lines) == 3
    assert lines[0].split() == ["ok", "a", "fine"]
    assert lines[1].startswith("FAIL")
    assert "broken badly" in lines[1]
    assert lines[1].endswith("-> mend it")
    assert lines[2].startswith("warn")
    assert "->" not in lines[0] + lines[2]
