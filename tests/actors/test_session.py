"""A session of Ray on this machine: starts and failed starts, deaths of its processes, and what is left of it."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from actors import local, running_time, session
from actors.session import Session, SessionFailed
from icrl_dist.diagnostics import ray_job

CHILD = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(600)'])"


TIMED_OUT = Exception("The current node timed out.\nOr something else did.")


class FakeRay:
    """A fake Ray that starts a process with a child process; the first ``failures`` attempts then raise ``error``."""

    def __init__(self, failures, error=TIMED_OUT):
        self.failures, self.error, self.started, self.shutdowns, self.folders = failures, error, [], 0, []
        self._private = SimpleNamespace(
            services=SimpleNamespace(resolve_ip_for_localhost=lambda host: "192.0.2.2"),
            worker=SimpleNamespace(print_to_stdstream=print),
            utils=SimpleNamespace(set_sigterm_handler=lambda handler: signal.signal(signal.SIGTERM, handler)),
        )

    def init(self, **options):
        assert options["num_cpus"] == 2 and options["address"] == "local"
        assert self._private.services.resolve_ip_for_localhost("127.0.0.1") == options["_node_ip_address"] == "127.0.0.1"
        self._private.utils.set_sigterm_handler(lambda *_: sys.exit(1))
        self.folders.append(Path(options["_temp_dir"]))
        assert len(f"{self.folders[-1]}/session_2026-11-30_10-33-20_824709_1234567/sockets/plasma_store") <= 107
        (self.folders[-1] / "session_2026-11-30" / "logs").mkdir(parents=True)
        (self.folders[-1] / "session_2026-11-30" / "logs" / "raylet.out").write_text("cause\n")
        process = subprocess.Popen([sys.executable, "-c", CHILD, str(self.folders[-1])])
        while not psutil.Process(process.pid).children():
            pass
        self.started.append([process, *psutil.Process(process.pid).children()])
        if len(self.started) <= self.failures:
            raise self.error

    def shutdown(self):
        self.shutdowns += 1

    def alive(self):
        return [[p.pid for p in family if psutil.pid_exists(p.pid)] for family in self.started]


@pytest.fixture
def fake_ray(monkeypatch, tmp_path):
    made = []

    def make(*arguments):
        made.append(FakeRay(*arguments))
        return made[-1]

    monkeypatch.setattr(ray_job, "job_config", lambda ray: None)
    monkeypatch.setattr(session, "_VITAL", (psutil.Process().name(), "python", "python3"))
    yield make
    for ray in made:
        for folder in ray.folders:
            for kept in (folder, folder.with_name(folder.name.replace("ray-", "ray-logs-"))):
                subprocess.run(["rm", "-rf", kept], check=True)
        for process, child in ray.started:
            if psutil.pid_exists(child.pid):
                child.kill()
            process.wait(10)


@pytest.mark.integration
def test_ray_is_started_again_and_only_the_processes_of_failed_starts_are_ended(fake_ray):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        ray, notes = fake_ray(2), list[str]()
        made = Session(ray, notes.append, num_cpus=2)
        assert [len(family) for family in ray.alive()] == [0, 0, 2] and ray.shutdowns == 2
        made.close()
        assert other.poll() is None
        other.communicate(b"\n")
    text = "Ray did not start on this machine (The current node timed out.): starting it again, "
    assert notes == [f"{text}2 of 3", f"{text}3 of 3"]
    assert ray.alive() == [[]] * 3 and not any(folder.exists() for folder in ray.folders)
    services, worker = ray._private.services, ray._private.worker
    assert services.resolve_ip_for_localhost("127.0.0.1") == "192.0.2.2" and worker.print_to_stdstream is print


@pytest.mark.integration
@pytest.mark.parametrize(
    ("error", "stopped", "tries"),
    [
        (Exception("timed out"), False, "3 times"),
        (Exception("timed out"), True, "once"),
        (ConnectionError("timed out"), True, "once"),
        (OSError("timed out"), False, "once"),
        (ValueError("timed out"), False, "once"),
    ],
)
def test_an_error_that_may_pass_is_tried_three_times_and_a_final_one_once(fake_ray, error, stopped, tries):
    ray = fake_ray(3, error)
    with pytest.raises(SessionFailed, match=rf"\(timed out\), tried {tries}; ") as caught:
        Session(ray, lambda text: None, lambda: stopped, num_cpus=2)
    kept = [folder.with_name(folder.name.replace("ray-", "ray-logs-")) for folder in ray.folders]
    assert [folder.exists() for folder in kept] == [False] * (len(kept) - 1) + [not stopped]
    assert stopped or str(caught.value).endswith(f"its logs are in {kept[-1]}"), "the message names the logs, so they are kept"
    assert stopped or (kept[-1] / "raylet.out").read_text() == "cause\n"
    assert not any(ray.alive()) and not any(folder.exists() for folder in ray.folders)


@pytest.mark.integration
def test_a_session_whose_process_was_killed_or_stopped_says_so_and_is_replaced(fake_ray, monkeypatch):
    monkeypatch.setattr(session, "STOPPED_S", 0.0)
    ray = fake_ray(0)
    made = Session(ray, print, num_cpus=2)
    try:
        assert made.failure() == ""
        process, _ = ray.started[0]
        process.kill()
        process.wait()
        assert made.failure().endswith(f"({process.pid}) has ended")
        made.restart()
        assert made.failure() == "" and [len(family) for family in ray.alive()] == [0, 2], "the orphan has ended too"
        os.kill(ray.started[1][0].pid, signal.SIGSTOP)
        deadline = time.monotonic() + 10
        while not made.failure():
            assert time.monotonic() < deadline
        assert made.failure().endswith("has been stopped for 0 s")
    finally:
        made.close()
    assert not any(ray.alive()) and not any(folder.exists() for folder in ray.folders)


def test_a_long_tmpdir_is_not_used_and_one_that_cannot_be_replaced_is_named(monkeypatch, tmp_path):
    long = tmp_path / ("x" * 100)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    monkeypatch.delenv("RAY_TMPDIR", raising=False)
    folder, lock = session._new_folder()
    lock.close()
    assert len(str(folder)) <= 24 + len("/icrl-ray-12345678") and folder.stat().st_mode & 0o777 == 0o700
    subprocess.run(["rm", "-rf", folder], check=True)
    monkeypatch.setattr(tempfile, "mkdtemp", lambda **_: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    with pytest.raises(OSError, match=rf"set RAY_TMPDIR to a short, writable one: {long}: longer than \d+ bytes.*/tmp: Perm"):
        session._new_folder()


def test_folders_of_killed_runs_are_removed_and_those_of_active_ones_and_recent_logs_are_not(monkeypatch, tmp_path):
    monkeypatch.setattr(session, "_BASE_BYTES", 1000)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    active, lock = session._new_folder()
    names = ("icrl-ray-deadbeef", "icrl-ray-logs-recent", "icrl-ray-logs-older", "icrl-ray-young", "other")
    for name, age_s in zip(names, (3600, 3600, 30 * 86400, 1, 30 * 86400), strict=True):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    os.utime(active, (0, 0))
    new, other_lock = session._new_folder()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {active.name, new.name, "icrl-ray-logs-recent", "icrl-ray-young", "other"}
    lock.close()
    other_lock.close()


def test_variables_that_name_another_ray_are_forgotten_and_settings_are_kept(monkeypatch):
    for name in local.variables():
        monkeypatch.delenv(name)
    monkeypatch.setenv("RAY_ADDRESS", "192.0.2.1:6379")
    monkeypatch.setenv("RAY_REDIS_ADDRESS", "192.0.2.1:6379")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "secret")
    monkeypatch.setenv("RAY_TMPDIR", "/tmp")
    monkeypatch.setenv("RAY_memory_usage_threshold", "0.9")
    before = local.variables()
    local.forget_other_clusters()
    assert local.variables().keys() == {"RAY_AUTH_TOKEN", "RAY_TMPDIR", "RAY_memory_usage_threshold"}
    local.restore_variables(before)
    assert local.variables() == before


@pytest.mark.parametrize("before", [None, 0o644, 0o640])
def test_the_token_is_readable_by_this_user_only(no_ray_token, monkeypatch, tmp_path, before):
    file = tmp_path / ".ray" / "auth_token"
    if before is not None:
        file.parent.mkdir()
        file.write_text("secret")
        file.chmod(before)
    local.protect_token()
    assert file.stat().st_mode & 0o777 == 0o600
    assert len(file.read_text()) == 64 if before is None else file.read_text() == "secret"


def test_without_a_writable_home_the_token_is_in_the_environment(no_ray_token, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "home"))
    (tmp_path / "file").write_text("")
    before = local.variables()
    local.protect_token()
    assert len(os.environ["RAY_AUTH_TOKEN"]) == 64
    local.restore_variables(before)
    assert "RAY_AUTH_TOKEN" not in os.environ


def test_a_running_time_does_not_count_a_stop(monkeypatch):
    now = 100.0
    monkeypatch.setattr(running_time, "time", SimpleNamespace(monotonic=lambda: now))
    clock = running_time.RunningTime()
    for step, expected in ((1.0, 1.0), (0.5, 1.5), (3600.0, 1.5 + running_time.GAP_S), (1.0, 2.5 + running_time.GAP_S)):
        now += step
        assert clock() == expected


@pytest.mark.integration
def test_sigterm_while_ray_starts_reaches_the_handler_of_the_program_and_leaves_nothing(fake_ray, monkeypatch):
    ray, received, init = fake_ray(0), list[int](), FakeRay.init

    def terminated(self, **options):
        init(self, **options)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(FakeRay, "init", terminated)
    before = signal.signal(signal.SIGTERM, lambda number, frame: received.append(number))
    try:
        Session(ray, lambda text: None, num_cpus=2).close()
        ray._private.utils.set_sigterm_handler(signal.SIG_DFL)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL, "Ray's function works again"
    finally:
        signal.signal(signal.SIGTERM, before)
    assert received == [signal.SIGTERM] and not any(ray.alive())
    assert not any(path.exists() for folder in ray.folders for path in folder.parent.glob(f"*{folder.name[-8:]}"))


@pytest.mark.integration
def test_an_interrupted_run_starts_no_new_session_and_ends_no_process_of_another(fake_ray):
    ray, interrupted = fake_ray(0), list[bool]()
    made = Session(ray, print, lambda: bool(interrupted), num_cpus=2)
    interrupted.append(True)
    with pytest.raises(SessionFailed, match="interrupted"):
        made.restart()
    with subprocess.Popen([sys.executable, "-c", "input()", "None"], stdin=subprocess.PIPE) as other:
        made.close()  # the session has no folder any more
        assert other.poll() is None
        other.communicate(b"\n")
    assert ray.alive() == [[]] and not any(folder.exists() for folder in ray.folders)
