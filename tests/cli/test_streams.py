"""The command's standard streams: closed at the start, a terminal that goes away, a reader that ends."""

import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time

import pytest

from icrl_dist.config.run import dumps
from icrl_dist.storage.checkpoint import partial_file
from learner import checkpoints

pytestmark = pytest.mark.integration

CLI = [sys.executable, "-m", "icrl_dist.cli"]


@pytest.mark.parametrize(("closed", "code"), [("<&-", 0), (">&-", 0), ("2>&-", 0), ("<&- >&- 2>&-", 0)])
def test_closed_streams_are_no_error_and_their_numbers_are_not_used_again(tmp_path, closed, code):
    """A file opened later would get the number 0, 1 or 2, and what a library prints would go into it."""
    script = """
import os, sys
from icrl_dist.cli import main
code = main.main(["--version"])
answer = os.open(sys.argv[1], os.O_CREAT | os.O_RDWR)
os.write(answer, f"{code} {answer > 2}".encode())
"""
    command = ["bash", "-c", f'"$@" {closed}', "bash", sys.executable, "-c", script, str(tmp_path / "answer")]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60).returncode == code
    assert (tmp_path / "answer").read_text() == "0 True"


@pytest.fixture
def in_terminal(module_run, tmp_path):
    """Start a run in one process with a terminal of its own, and wait until it fits; returns the process and the terminal."""
    (tmp_path / "small.toml").write_text(dumps(module_run))
    processes = []

    def start(steps, hangup):
        ours, theirs = pty.openpty()

        def take_terminal():
            signal.signal(signal.SIGHUP, hangup)
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        command = [*CLI, "train", str(tmp_path / "small.toml"), "--engine", "inline", "--pretrain.steps", str(steps)]
        process = subprocess.Popen(
            [*command, "--out", str(tmp_path / "run")],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=take_terminal,
        )
        processes.append(process)
        os.close(theirs)
        shown, deadline = b"", time.monotonic() + 120
        while b"fit T^0" not in shown:
            assert time.monotonic() < deadline, shown
            if select.select([ours], [], [], 1)[0]:
                shown += os.read(ours, 65536)
        return process, ours

    yield start
    for process in processes:
        process.kill()
        process.wait()


def test_a_terminal_that_goes_away_ends_the_run_with_a_checkpoint(in_terminal, tmp_path):
    process, terminal = in_terminal(10**6, signal.SIG_DFL)
    os.close(terminal)  # the kernel sends SIGHUP, and every further output fails with EIO
    assert process.wait(60) == 130
    assert checkpoints.read_manifest(partial_file(tmp_path / "run"))["step"] > 0


def test_with_sighup_ignored_the_run_goes_on_without_its_terminal(in_terminal, tmp_path):
    process, terminal = in_terminal(300, signal.SIG_IGN)
    os.close(terminal)
    assert process.wait(120) == 0
    assert (tmp_path / "run" / "result.json").exists()


def test_a_reader_that_ends_leaves_a_checkpoint_and_a_line_on_stderr(module_run, tmp_path):
    (tmp_path / "small.toml").write_text(dumps(module_run))
    words = f"{sys.executable} -m icrl_dist.cli train {tmp_path}/small.toml --engine inline --out {tmp_path}/run"
    done = subprocess.run(
        ["bash", "-c", f"{words} | head -1; exit ${{PIPESTATUS[0]}}"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 141 and len(done.stdout.splitlines()) == 1
    assert len(done.stderr.splitlines()) == 1, done.stderr
    line = done.stderr
    assert "the output is closed; `icrl-dist train" in line and "--resume" in line and "continues" in line
    assert (tmp_path / "run" / "checkpoints").is_dir() and not (tmp_path / "run" / "result.json").exists()
