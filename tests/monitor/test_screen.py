"""The terminal view, driven by its keys: what it says of a run, and what no run can make it do."""

import asyncio
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from icrl_dist.cli.main import main
from icrl_dist.monitor.lines import Column, Scroll, cell, fit
from icrl_dist.monitor.overlays import Detail, Help
from icrl_dist.monitor.recording import Recording
from icrl_dist.monitor.screen import MonitorApp
from icrl_dist.monitor.tables import Table
from icrl_dist.monitor.view_state import duration, matches
from icrl_dist.stream import wire
from tests.monitor.fake_feed import BEGAN, FakeFeed, episode, run_folder


def shown(app, name):
    return app.screen.query_one(f"#{name}").lines


def text(app, name):
    return "\n".join(shown(app, name))


def rows(app, name):
    """The first cell of every row."""
    return [line.split("  ")[0].strip() for line in shown(app, name)[2:]]


def drive(feed, script, size=(130, 44)):
    """Run the view without a terminal while ``script(app, press)`` acts."""

    async def act():
        app = MonitorApp(feed)
        async with app.run_test(size=size) as pilot:

            async def press(*keys):
                await pilot.press(*keys)
                app.update_view()
                await pilot.pause()

            await press()
            await script(app, press)
        return app

    return asyncio.run(act())


def test_everything_is_said_of_a_run(monkeypatch):
    feed = FakeFeed()
    feed.send_run_in_progress()
    feed.send_progress("fit", 30, 120, loss=0.731, drops={"checksum": 3})
    feed.pass_time(1.0)

    async def script(app, press):
        header = text(app, "header")
        for part in ("demo", "icaa · darkroom", "fitting", "round 1 of 1", "T^0", "310 stored", "fit T^1", " 25%  30 of 120"):
            assert part in header
        assert rows(app, "variations") == [f"{t}/{v}" for t in range(4) for v in range(2)]
        first = shown(app, "variations")[2]
        assert re.search(r"^0/0 +null +adapt/0 +5\.0 +3\.0 +6\.0 +50% ▁▂▃▅▆▇", first), first
        assert rows(app, "workers") == ["working", "working"] and "w1" in text(app, "workers")
        assert "0.7310" in text(app, "rates") and "checksum" in text(app, "rates")
        assert "quit" in text(app, "keys") and "seek" not in text(app, "keys")

    drive(feed, script)


def test_a_small_terminal_shows_one_pane_at_a_time():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        assert "variations 8" in text(app, "tabs") and "workers 2" in text(app, "tabs")
        assert "steps/s" in text(app, "header"), "rates in short"
        panes = ["variations", "workers", "rates", "events"]
        for i, name in enumerate([*panes, panes[0]]):
            assert [p for p in panes if app.query_one(f"#{p}").display] == [name], i
            await press("tab")
        await press("4")
        assert app.focused.id == "events"
        for line in shown(app, "header") + shown(app, "keys"):
            assert len(line) <= 80, line

    drive(feed, script, (80, 24))


def test_sorting_goes_through_the_columns_and_back_and_the_cursor_stays_on_its_row():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        table = app.query_one("#variations", Table)
        await press("down", "down")
        assert table.move(0) == "1/0"
        await press("s")
        assert "by share" in shown(app, "variations")[0]
        places = rows(app, "variations")
        shares = [int(re.search(r"(\d+)%", line)[1]) for line in shown(app, "variations")[2:]]
        assert shares == sorted(shares) and table.move(0) == "1/0"
        await press("S")
        assert rows(app, "variations")[0] == places[-1]

    drive(feed, script)


def test_a_filter_is_typed_and_cleared():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        await press("slash", *"task", "space", "3")
        assert rows(app, "variations") == ["3/0", "3/1"]
        await press("enter", "slash", *("backspace",) * 6, *"dirichlet")
        assert rows(app, "variations") == [f"{t}/1" for t in range(4)]
        assert "only dirichlet: 4" in shown(app, "variations")[0]
        await press("slash", *"qs")
        assert "none matches" in text(app, "variations"), "keys are letters while one types"
        await press("escape")
        assert len(rows(app, "variations")) == 8 and app.focused.id == "variations"

    drive(feed, script)


@pytest.mark.parametrize(
    ("wanted", "does"),
    [
        ("", True),
        ("task 3", True),
        ("task 31", False),
        ("task 3/1", True),
        ("task 3/2", False),
        ("NULL 3/1", True),
        ("task null", True),
        ("task", False),
        ("null dirichlet", False),
        ("null task 3", True),
    ],
)
def test_what_a_filter_matches(wanted, does):
    assert matches({"task": 3, "variation": 1, "search_text": "3/1 adapt/0 null goal 2,2"}, wanted) == does


def test_a_variation_opens_with_returns_path_and_lineage():
    feed = FakeFeed()
    feed.send_run_in_progress()
    feed.send_episode(episode(1, 1, 5))

    async def script(app, press):
        await press("down", "down", "down", "enter")
        assert isinstance(app.screen, Detail)
        app.screen.query_one(Scroll).styles.height = 70  # all of it
        await press()
        sheet = text(app, "sheet")
        assert "VARIATION 1/1" in sheet and "dirichlet" in sheet and "alpha 0.5,0.1,2,1,0.7" in sheet
        assert "RETURNS, adapt/0  6 episodes" in sheet and "optimum" in sheet
        assert re.search(r"2 +3 +4 *\n +1 +· +·", sheet), "the path, from above"
        assert re.search(r"adapt/0/1/1/5 +0\.0 +T\^0 +abababababab +w1", sheet)
        await press("right_square_bracket")
        assert "VARIATION 2/0" in text(app, "sheet")
        await press("escape")
        assert not isinstance(app.screen, Detail)

    drive(feed, script)


def test_trouble_comes_first_and_in_words():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        feed.send("event", what="worker", text="worker w1 is gone", worker="w1", alive=False)
        feed.send("event", what="alert", alert="returns", active=True, text="returns fell by half")
        cause = "three workers ended in it"
        feed.send("event", what="quarantine", identity="adapt/0/2/1", text=cause)
        for _ in range(4):
            feed.pass_time(0.5)
            feed.send_heartbeat("w0")
        await press()
        assert shown(app, "workers")[2].startswith("gone 3 s") and "w1" in shown(app, "workers")[2]
        assert "ALERT returns fell by half" in text(app, "header")
        assert rows(app, "variations")[0] == "2/1" and f"QUARANTINED: {cause}" in shown(app, "variations")[2]
        assert "worker w1 is gone" in shown(app, "events")[1] and cause in shown(app, "events")[3]
        feed.send("event", what="alert", alert="returns", active=False, text="returns recovered")
        feed.pass_time(3.0)
        await press()
        assert "ALERT" not in text(app, "header") and "SILENT for 6 s" in text(app, "header")
        assert "silent 3 s" in text(app, "workers")

    drive(feed, script)


HOSTILE = "[bold red]x[/] [/nope] \x1b[2J\x07\u202e\ud7ff 名前 e\u0301\u0301 $(reboot) [@click=app.quit]go[/]"


@pytest.mark.parametrize("size", [(80, 24), (130, 44)])
def test_names_from_the_network_are_only_ever_text(size):
    feed = FakeFeed()
    feed.send_progress(phase=None)  # the first that is heard of the run
    feed.send_run_in_progress()
    feed.state.receive("icrl/demo/mon/event", wire.encode_message("event", what="x", text="x", time=1e300), feed.time)
    feed.send_heartbeat(HOSTILE, job=HOSTILE, doing=HOSTILE)
    feed.send("event", what="[red]", text=HOSTILE * 5)
    feed.send("event", what="alert", alert="[/]", active=True, text=HOSTILE)
    feed.send("event", what="quarantine", identity="adapt/0/0/0", text=HOSTILE)
    bad = episode(0, 1, 6)
    feed.state.receive("icrl/demo/mon/trajectories/x", b"\x81\xa1v\x01", feed.time)
    feed.state.receive("icrl/other/mon/learner", b"", feed.time)
    object.__setattr__(bad, "worker", HOSTILE)
    feed.send_trajectory(bad)
    feed.pass_time(1.0)

    async def script(app, press):
        seen = []
        for number in "1234":
            await press(number)
            seen += [line for name in ("header", "variations", "workers", "rates", "events") for line in shown(app, name)]
        await press("1", "home", "down", "enter")
        seen += shown(app, "sheet")
        whole = "\n".join(seen)
        assert "[bold red]x[/] [/nope]" in whole and "名前" in whole
        assert all(line.isprintable() for line in seen)
        assert "\u0301" not in whole, "nothing that takes no cell"
        assert "QUARANTINED: [bold red]" in whole
        svg = app.export_screenshot()
        assert "\x1b" not in svg and app.is_running

    drive(feed, script, size)


def test_p_freezes_a_run_that_is_on_and_shows_it_as_it_is_afterwards():
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
        assert "VARIATION 0/0" in text(app, "sheet") and "6 episodes" in text(app, "sheet"), "first asked for while frozen"
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
    assert feed.controls == [], "a run that is on cannot be paused"


def test_the_keys_of_a_recording():
    feed = FakeFeed({"begin": BEGAN, "end": BEGAN + 200, "at": BEGAN + 100, "speed": 10.0, "paused": False})
    feed.send_run_in_progress()

    async def script(app, press):
        assert "recording at 10x" in text(app, "header") and "1:40 of 3:20" in text(app, "header")
        await press("plus", "left", "p")
        assert "recording PAUSED" in text(app, "header") and "1:30 of 3:20" in text(app, "header")
        await press("p", "minus", "minus", "right")

    drive(feed, script)
    wanted = [{"speed": 20.0}, {"at": BEGAN + 90}, {"paused": True}, {"paused": False}, {"speed": 10.0}, {"speed": 5.0}]
    assert feed.controls == [*wanted, {"at": BEGAN + 100}]


def test_a_recording_that_is_wound_back_is_seen_anew():
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


def test_many_variations_are_a_window_and_a_count():
    feed = FakeFeed()
    payload = [episode(t, v) for t in range(13) for v in range(20)]
    for trajectory in payload:
        feed.send_trajectory(trajectory)
    feed.pass_time(1.0)

    async def script(app, press):
        assert re.search(r"1-\d+ of 260, 2\d\d more below", shown(app, "variations")[0])
        await press("end")
        assert rows(app, "variations")[-1] == "12/19"
        await press("pageup", "home")
        assert rows(app, "variations")[0] == "0/0"

    drive(feed, script)


def test_what_is_told_twice_is_shown_once():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        feed.send("event", what="note", text="a note")  # told now, and once more after the next tick
        await press()
        feed.pass_time(1.0)
        await press()
        assert text(app, "events").count("a note") == 1

    drive(feed, script)


def test_only_lines_that_differ_are_drawn_again():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        table, drawn = app.query_one("#variations", Table), []
        refresh = table.refresh
        table.refresh = lambda *regions, **kw: (drawn.extend(region.y for region in regions), refresh(*regions, **kw))[1]
        app.update_view()
        assert drawn == []
        feed.send_trajectory(episode(2, 0, 6, total=1))
        feed.pass_time(0.25)
        app.update_view()
        assert drawn == [2 + 4]
        table.refresh = refresh

    drive(feed, script)


def test_help_and_the_ways_out():
    feed = FakeFeed()

    async def asked(app, press):
        await press("question_mark")
        assert isinstance(app.screen, Help) and "sort by the next column" in text(app, "sheet")
        await press("q")

    assert drive(feed, asked).return_code == 0

    async def interrupted(app, press):
        await press("slash", "ctrl+c")

    assert drive(feed, interrupted).return_code == 130


def test_columns_give_way_by_rank_and_the_rest_is_stretched():
    columns = [Column("a", "", 4), Column("b", "", 6, rank=2, stretch=1), Column("c", "", 5, rank=1)]
    assert [(c.name, w) for c, w in fit(columns, 30)] == [("a", 4), ("b", 18), ("c", 5)]
    assert [(c.name, w) for c, w in fit(columns, 12)] == [("a", 4), ("c", 5)]
    assert [(c.name, w) for c, w in fit(columns, 1)] == [("a", 4)]


@pytest.mark.parametrize(
    ("given", "width", "told"), [("abc", 5, "abc  "), ("abcdef", 4, "abc…"), ("名前x", 4, "名 …"), ("", 2, "  ")]
)
def test_a_cell_is_as_wide_as_it_says(given, width, told):
    assert cell(given, width) == told


@pytest.mark.parametrize(("seconds", "told"), [(None, "-"), (7.9, "0:07"), (201, "3:21"), (3723, "1:02:03")])
def test_durations(seconds, told):
    assert duration(seconds) == told


def test_what_was_rolled_out_by_new_weights_is_played_after_they_were_fitted(tmp_path):
    recording = Recording(run_folder(tmp_path / "run"))
    try:
        said = [(then - BEGAN, payload) for then, key, payload in recording.messages() if "/trajectories/" in key]
    finally:
        recording.close()
    assert len(said) == 72
    assert max(then for then, payload in said if b"pretrain/" in payload) <= 2
    assert min(then for then, payload in said if b"adapt/" in payload) > 6


def test_without_a_terminal_it_says_what_to_do_instead(tmp_path, capsys):
    assert main(["monitor", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "no terminal" in told and "--web" in told and "icrl-dist tap" in told and told.count("\n") == 1


@pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux, a terminal to look into")
def test_a_real_terminal_shows_a_recording_and_is_left_as_it_was(tmp_path):
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
        assert "VARIATIONS" not in screen, "the terminal is as it was"
    finally:
        tmux("kill-server")
