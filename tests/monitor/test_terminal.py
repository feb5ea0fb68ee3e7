"""The terminal view with a frozen run, with a recording, and in a real terminal."""

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from icrl_dist.cli.main import main
from tests.monitor.fake_feed import BEGAN, FakeFeed, episode, run_folder
from tests.monitor.terminal import drive, rows, text

pytestmark = pytest.mark.integration


def test_p_freezes_the_view_of_a_live_run_and_unfreezes_it():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        await press("p")
        assert "FROZEN" in text(app, "header")
        feed.send_progress(step=90)
        feed.pass_time(1.0)
        await press()
        assert "30 of 120" in text(app, "header")
        await press("enter")
        assert "VARIATION 0/0" in text(app, "sheet") and "6 episodes" in text(app, "sheet"), "first opened while frozen"
        feed.send_trajectory(episode(0, 0, 6))
        await press()
        assert "6 episodes" in text(app, "sheet")
        await press("right_square_bracket")
        assert "VARIATION 0/1" in text(app, "sheet") and "adapt/0/0/0/" not in text(app, "sheet")
        await press("left_square_bracket")
        assert "VARIATION 0/0" in text(app, "sheet") and "7 episodes" in text(app, "sheet")
        await press("escape", "p")
        assert "90 of 120" in text(app, "header") and "FROZEN" not in text(app, "header")

    drive(feed, script)
    assert feed.controls == [], "a live run has no pause"


def test_the_keys_of_a_recording():
    feed = FakeFeed({"begin": BEGAN, "end": BEGAN + 200, "at": BEGAN + 100, "speed": 10.0, "paused": False})
    feed.send_run_in_progress()

    async def script(app, press):
        assert "recording at 10x" in text(app, "header") and "1:40 of 3:20" in text(app, "header")
        await press("plus", "left", "p")
        assert "recording PAUSED" in text(app, "header") and "1:30 of 3:20" in text(app, "header")
        await press("p", "minus", "minus", "right")

    drive(feed, script)
    expected = [{"speed": 20.0}, {"at": BEGAN + 90}, {"paused": True}, {"paused": False}, {"speed": 10.0}, {"speed": 5.0}]
    assert feed.controls == [*expected, {"at": BEGAN + 100}]


def test_a_recording_after_seeking_back_replaces_the_view():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        assert len(rows(app, "variations")) == 8
        feed.state.clear()
        feed.send_trajectory(episode(5, 0, 0))
        feed.pass_time(1.0)
        await press()
        assert rows(app, "variations") == ["5/0"]

    drive(feed, script)


def test_without_a_terminal_the_error_names_the_alternatives(tmp_path, capsys):
    assert main(["monitor", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "no terminal" in error and "--web" in error and "icrl-dist tap" in error and error.count("\n") == 1


@pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux, whose terminal can be read")
def test_a_real_terminal_shows_a_recording_and_is_restored(tmp_path):
    folder, socket = run_folder(tmp_path / "night"), str(tmp_path / "tmux")
    command = f"{sys.executable} -m icrl_dist.cli monitor {folder}; echo left with $?; cat"

    def tmux(*arguments):
        done = subprocess.run(["tmux", "-S", socket, *arguments], capture_output=True, text=True, timeout=20, check=True)
        return done.stdout

    def wait_for(*patterns):
        deadline = time.monotonic() + 120
        while not all(re.search(pattern, screen := tmux("capture-pane", "-p", "-t", "view")) for pattern in patterns):
            assert time.monotonic() < deadline, screen
            time.sleep(0.2)
        return screen

    tmux("-f", "/dev/null", "new-session", "-d", "-s", "view", "-x", "100", "-y", "30", "-c", str(Path.cwd()), command)
    try:
        tmux("send-keys", "-t", "view", "")
        screen = wait_for("night  icaa · darkroom", r"2/1 .*dirichlet.* adapt/0 .*[▁▂▃▄▅▆▇█]{4}")
        assert "recording" in screen and "q quit" in screen
        tmux("send-keys", "-t", "view", "q")
        screen = wait_for("left with 0")
        assert "VARIATIONS" not in screen, "the terminal is restored"
    finally:
        tmux("kill-server")
