"""The doctor finds beforehand what would disturb a run: odd variables, folders, locks, a wrong clock."""

import errno
import fcntl
import os
import pwd
import time

import pytest

from icrl_dist.diagnostics import surroundings
from icrl_dist.problems.continuous import renderer
from tests.calls import failing


@pytest.fixture
def check(monkeypatch):
    """``check(name)``: the check of this name, None if it is not made."""
    for name in ("RAY_ADDRESS", "RAY_TMPDIR", "TMPDIR", "MUJOCO_GL", *surroundings._CACHES):
        monkeypatch.delenv(name, raising=False)
    return lambda name: next((one for one in surroundings.checks() if one.name == name), None)


def test_nothing_is_found_in_plain_surroundings(check, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    found = list(surroundings.checks())
    assert all(one.ok is True and not one.remedy for one in found) and not list(tmp_path.iterdir()), found


def test_a_user_without_a_home_is_a_warning(check, monkeypatch):
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(pwd, "getpwuid", failing(KeyError("uid not found: 12345")))
    for name in ("home", "expert cache"):
        found = check(name)
        assert found.ok is None and found.remedy
    assert "no passwd entry" in check("home").value


def test_a_home_that_is_a_file_is_a_warning(check, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert check("home").ok is None and check("expert cache").ok is None


@pytest.mark.parametrize("value", ["relative", "/dev/null"])
def test_folders_of_libraries_are_checked_if_variables_name_them(check, tmp_path, monkeypatch, value):
    assert check("XDG_CACHE_HOME") is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert check("XDG_CACHE_HOME") is None
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    found = check("XDG_CACHE_HOME")
    assert found.ok is None and value in found.value and "unset" in found.remedy


@pytest.mark.parametrize("value", ["/nonexistent", "/dev/null", "/tmp/" + "x" * 40])
def test_a_temporary_folder_that_cannot_hold_sockets_is_named(check, monkeypatch, value):
    monkeypatch.setenv("TMPDIR", value)
    found = check("temporary folder")
    assert found.ok is None and value in found.value and "/tmp is used" in found.remedy
    monkeypatch.setattr(surroundings, "SOCKETS_BYTES", 3)
    assert check("temporary folder").ok is False


def test_the_address_of_another_cluster_is_named(check, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "192.0.2.1:6379")
    found = check("RAY_ADDRESS")
    assert found.ok is None and "192.0.2.1:6379" in found.value and "unset RAY_ADDRESS" in found.remedy


def test_a_clock_before_the_installation_is_a_warning(check, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 1e9)
    found = check("clock")
    assert found.ok is None and "2001-09-09" in found.value


def test_a_renderer_that_is_not_there_is_named(check, monkeypatch):
    assert check("MUJOCO_GL") is None
    monkeypatch.setattr(renderer, "missing", ["MUJOCO_GL=osmesa: no library"])
    found = check("MUJOCO_GL")
    assert found.ok is None and "osmesa" in found.value and "unset MUJOCO_GL" in found.remedy


def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch):
    assert surroundings.check_locks(tmp_path / "runs").ok is True
    monkeypatch.setattr(fcntl, "flock", failing(OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))))
    found = surroundings.check_locks(tmp_path / "runs")
    assert found.ok is None and "No locks available" in found.value and not list(tmp_path.iterdir())
