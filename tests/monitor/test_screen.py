"""The terminal view, driven by its keys: panes, tables, overlays, and untrusted text."""

import re

import pytest

from icrl_dist.monitor.lines import Scroll
from icrl_dist.monitor.overlays import Detail, Help
from icrl_dist.monitor.tables import Table
from icrl_dist.stream import wire
from tests.monitor.fake_feed import FakeFeed, episode
from tests.monitor.terminal import drive, rows, shown, text
from tests.optional import known


def test_the_view_shows_all_parts_of_a_run(monkeypatch):
    feed = FakeFeed()
    feed.send_run_in_progress()
    feed.send_progress("fit", 30, 120, loss=0.731, drops={"checksum": 3})
    feed.pass_time(1.0)

    async def script(app, press):
        header = text(app, "header")
        for part in (
            "demo",
            "icaa · darkroom",
            "fitting",
            "Round 1 of 1 (adapt/0)",
            "T^0",
            "310 stored",
            "adapt/0: fit T^1",
            " 25%  30 of 120",
        ):
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
        assert "steps/s" in text(app, "header"), "a line of rates in the header"
        panes = ["variations", "workers", "rates", "events"]
        for i, name in enumerate([*panes, panes[0]]):
            assert [p for p in panes if app.query_one(f"#{p}").display] == [name], i
            await press("tab")
        await press("4")
        assert app.focused.id == "events"
        for line in shown(app, "header") + shown(app, "keys"):
            assert len(line) <= 80, line

    drive(feed, script, (80, 24))


def test_sorting_keeps_the_cursor_on_its_row():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        table = app.query_one("#variations", Table)
        await press("down", "down")
        assert table.move(0) == "1/0"
        await press("s")
        assert "by share" in shown(app, "variations")[0]
        places = rows(app, "variations")
        shares = [int(known(re.search(r"(\d+)%", line))[1]) for line in shown(app, "variations")[2:]]
        assert shares == sorted(shares) and table.move(0) == "1/0"
        await press("S")
        assert rows(app, "variations")[0] == places[-1]

    drive(feed, script)


def test_a_filter_is_typed_and_removed():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        await press("slash", *"task", "space", "3")
        assert rows(app, "variations") == ["3/0", "3/1"]
        await press("enter", "slash", *("backspace",) * 6, *"dirichlet")
        assert rows(app, "variations") == [f"{t}/1" for t in range(4)]
        assert "only dirichlet: 4" in shown(app, "variations")[0]
        await press("slash", *"qs")
        assert "no row matches" in text(app, "variations"), "keys are letters in the filter"
        await press("escape")
        assert len(rows(app, "variations")) == 8 and app.focused.id == "variations"

    drive(feed, script)


def test_a_variation_opens_with_returns_path_and_lineage():
    feed = FakeFeed()
    feed.send_run_in_progress()
    feed.send_episode(episode(1, 1, 5))

    async def script(app, press):
        await press("down", "down", "down", "enter")
        assert isinstance(app.screen, Detail)
        app.screen.query_one(Scroll).styles.height = 70  # enough for the whole text
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
def test_text_from_the_network_is_never_markup_or_control(size):
    feed = FakeFeed()
    feed.send_progress(phase=None)  # an invalid first message
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
        lines = []
        for number in "1234":
            await press(number)
            lines += [line for name in ("header", "variations", "workers", "rates", "events") for line in shown(app, name)]
        await press("1", "home", "down", "enter")
        lines += shown(app, "sheet")
        whole = "\n".join(lines)
        assert "[bold red]x[/] [/nope]" in whole and "名前" in whole
        assert all(line.isprintable() for line in lines)
        assert "\u0301" not in whole, "no characters that take no cell"
        assert "QUARANTINED: [bold red]" in whole
        svg = app.export_screenshot()
        assert "\x1b" not in svg and app.is_running

    drive(feed, script, size)


def test_many_variations_are_scrolled_and_counted():
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


def test_an_event_in_two_snapshots_is_shown_once():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        feed.send("event", what="note", text="a note")  # in this snapshot and in the next one
        await press()
        feed.pass_time(1.0)
        await press()
        assert text(app, "events").count("a note") == 1

    drive(feed, script)


def test_only_changed_lines_are_drawn_again():
    feed = FakeFeed()
    feed.send_run_in_progress()

    async def script(app, press):
        table, drawn = app.query_one("#variations", Table), list[int]()
        real = table.refresh

        def refresh(*regions, **options):
            drawn.extend(region.y for region in regions)
            return real(*regions, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(table, "refresh", refresh)
            app.update_view()
            assert drawn == []
            feed.send_trajectory(episode(2, 0, 6, total=1))
            feed.pass_time(0.25)
            app.update_view()
            assert drawn == [2 + 4]

    drive(feed, script)


def test_help_and_exit_codes():
    feed = FakeFeed()

    async def help_and_quit(app, press):
        await press("question_mark")
        assert isinstance(app.screen, Help) and "sort by the next column" in text(app, "sheet")
        await press("q")

    assert drive(feed, help_and_quit).return_code == 0

    async def interrupt(app, press):
        await press("slash", "ctrl+c")

    assert drive(feed, interrupt).return_code == 130
