"""One address for a folder of runs: the list, requests for a run by name, runs that begin later, the terminal's loop."""

import contextlib
import json
import os
import time
from urllib.parse import quote

import pytest
from rich.console import Console

from icrl_dist.cli import monitor as command
from icrl_dist.config.run import ConfigError
from icrl_dist.monitor import folder as folder_module
from icrl_dist.monitor import headline, run_list, screen
from icrl_dist.monitor.folder import FolderViews, open_feed, serving_folder
from icrl_dist.monitor.run_list import RunList, find, state
from icrl_dist.storage.files import hold
from tests.monitor.fake_feed import FakeFeed, run_folder
from tests.monitor.test_serve import PageClient, ViewerClient, wait_for
from tests.optional import known


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(run_list, "_PERIOD_S", 0.02)
    monkeypatch.setattr(folder_module, "_PERIOD_S", 0.02)


def begun(path, at):
    """A run folder that began at this time."""
    run_folder(path)
    os.utime(path / "run.toml", (at, at))
    return path


class FolderClient(PageClient):
    """Requests to the page of a folder."""

    def __init__(self, url):
        super().__init__(url, None, None)

    def get(self, path):
        status, _, body = self.request("GET", path)
        return status, body.decode()

    def runs(self):
        return json.loads(self.get("/runs")[1])

    @contextlib.contextmanager
    def events(self, name):
        import http.client

        connection = http.client.HTTPConnection(self.host, self.port, timeout=5)
        connection.request("GET", f"/events?run={quote(name, safe='')}")
        response = connection.getresponse()
        assert response.status == 200, response.read()
        try:
            yield ViewerClient(connection, response)
        finally:
            connection.close()
            response.close()


def test_runs_are_listed_newest_first_and_those_at_work_before_the_others(tmp_path):
    for at, name in enumerate(("old", "middle", "new")):
        begun(tmp_path / name, 1000.0 + at)
    (tmp_path / "notes").mkdir()
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "run.toml").touch()
    (tmp_path / "run.txt").touch()
    assert [run.name for run in find(tmp_path)] == ["new", "middle", "old"]
    with hold(tmp_path / "old"):
        (tmp_path / "old" / "endpoint").write_text("tcp/127.0.0.1:1")
        assert [(run.name, run.live) for run in find(tmp_path)] == [("old", True), ("new", False), ("middle", False)]
        assert state(find(tmp_path)[0]) == "training"
    assert not find(tmp_path)[0].live, "a killed learner leaves its endpoint file behind"
    assert find(tmp_path / "missing") == []
    assert [run.name for run in find(tmp_path / "old")] == ["old"], "a folder that became a run itself"


def test_the_state_of_a_run_is_read_from_its_files(tmp_path):
    path = begun(tmp_path / "run", 1.0)
    assert state(find(tmp_path)[0]) == "finished"
    with hold(path):
        assert state(find(tmp_path)[0]) == "evaluating"
        with (path / "metrics.jsonl").open("a") as file:
            file.write(json.dumps({"time": 1e9, "stage": "heldout", "step": 2, "share": 0.5}) + "\n")
        assert state(find(tmp_path)[0]) == "evaluating", "the evaluation writes rows too"
        rows = (path / "metrics.jsonl").read_text()
        (path / "metrics.jsonl").write_text("")
        assert state(find(tmp_path)[0]) == "starting"
        (path / "metrics.jsonl").write_text("".join(row for row in rows.splitlines(True) if "finished" not in row))
        assert state(find(tmp_path)[0]) == "training", "in one process, so there is no endpoint"
    assert state(find(tmp_path)[0]) == "interrupted"


def test_names_are_plain_text_and_never_lead_out_of_the_folder(tmp_path):
    inside, outside = tmp_path / "runs", begun(tmp_path / "outside", 5.0)
    for at, name in enumerate(("a\x1b[2J", "a\x1b]2J", b"b\xff".decode("utf-8", "surrogateescape"), "<img src=x>")):
        begun(inside / name, at)
    (inside / "link").symlink_to(outside)
    names = [run.name for run in find(inside)]
    assert names == ["<img src=x>", "b\ufffd", "a\ufffd]2J", "a\ufffd[2J"]
    with serving_folder(inside, "127.0.0.1", 0) as url:
        client = FolderClient(url)
        for name in ("../outside", "link", "..", ".", "", "/etc", str(outside), "a\x1b[2J", "b\0"):
            for path in (f"/events?run={quote(name, safe='')}", f"/variation/0/0?run={quote(name, safe='')}"):
                status, text = client.get(path)
                assert status == 404 and text.isprintable() and text.endswith("in this folder"), path
            assert client.command(json.dumps({"run": name, "paused": True}))[0] == 400
        assert client.get("/events")[0] == 404
        assert client.command('{"run": ["x"], "paused": true}')[0] == 400
        with client.events("<img src=x>") as viewer:
            assert viewer.next()[0] == "picture"
        for name in names[1:]:  # listed, although no run can have such a name
            status, text = client.get(f"/events?run={quote(name, safe='')}")
            assert status == 503 and text.isprintable() and "unprintable characters" in text


def test_two_names_that_look_the_same_are_numbered(tmp_path):
    for at, name in enumerate(("a\x01", "a\x02")):
        begun(tmp_path / name, at)
    assert {run.name: run.folder.name for run in find(tmp_path)} == {"a\ufffd": "a\x01", "a\ufffd (2)": "a\x02"}


def test_a_folder_may_be_empty_at_first_and_two_runs_are_watched_at_once(tmp_path):
    folder = tmp_path / "runs"
    with serving_folder(folder, "127.0.0.1", 0) as url:
        client = FolderClient(url)
        assert client.runs() == {"folder": str(folder), "newest": None, "runs": [], "left_out": 0}
        begun(folder / "one", 1.0)
        wait_for(lambda: client.runs()["newest"] == "one")
        begun(folder / "two", 2.0)
        wait_for(lambda: client.runs()["newest"] == "two")
        rows = [(name, "icaa", "darkroom", "finished") for name in ("two", "one")]
        shown = ("name", "method", "problem", "state")
        wait_for(lambda: [tuple(row[key] for key in shown) for row in client.runs()["runs"]] == rows)
        with client.events("one") as first, client.events("two") as second:
            for name, viewer in (("one", first), ("two", second)):
                _, shown = viewer.next()
                while shown["run"]["state"] != "finished":  # a finished run is shown at its end
                    _, shown = viewer.next()
                assert shown["run"]["name"] == name and shown["replay"]["at"] == shown["replay"]["end"]
            assert client.command('{"run": "one", "paused": true}')[0] == 204
            while not first.next()[1]["replay"]["paused"]:
                pass
            assert not second.next()[1]["replay"]["paused"]
        status, text = client.get("/variation/1/1?run=one")
        assert status == 200 and json.loads(text)["name"] == "1/1"


def test_a_run_that_cannot_be_shown_yet_is_listed_with_the_reason(tmp_path):
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "run.toml").write_text("method = 3\n")
    with contextlib.closing(RunList(tmp_path)) as runs:
        (row,) = runs.listed()["runs"]
    assert row["state"] == "interrupted" and "method" in row["note"] and len(row["note"].splitlines()) == 1
    with serving_folder(tmp_path, "127.0.0.1", 0) as url:
        status, text = FolderClient(url).get("/events?run=bad")
        assert status == 503 and "method" in text


class Opener:
    """Opens fake feeds, and counts them."""

    def __init__(self):
        self.open, self.opened = [], 0

    @contextlib.contextmanager
    def __call__(self, run):
        self.open.append(run.name)
        self.opened += 1
        yield FakeFeed()
        self.open.remove(run.name)


def test_runs_that_nobody_watches_are_closed_and_a_resumed_run_is_opened_again(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_module, "_PERIOD_S", 30.0)
    for number in range(folder_module.MAX_OPEN + 1):
        begun(tmp_path / f"run{number}", number)
    opener = Opener()
    with contextlib.closing(FolderViews(tmp_path, opener)) as views:
        for number in range(folder_module.MAX_OPEN):
            views.watched(f"run{number}")
        with pytest.raises(ConfigError, match="8 runs are watched at once"):
            views.watched("run8")
        views._open["run3"].asked -= 31.0
        views.watched("run8")
        assert "run3" not in opener.open and "run8" in opener.open
        views._open["run8"].asked -= 100.0
        views.refresh()
        assert "run8" not in opener.open
        views._open["run7"].asked -= 31.0
        views.refresh()
        assert "run7" in opener.open, "it may be watched again soon"
        with hold(tmp_path / "run7"):
            (tmp_path / "run7" / "endpoint").write_text("tcp/127.0.0.1:1")
            views.refresh()
            assert "run7" not in opener.open, "its viewers connect again, to its learner"
            views.watched("run7")
            views.refresh()
            assert "run7" in opener.open
    assert opener.open == []


def test_held_out_results_are_listed_once_they_are_known_and_read_again_if_they_change(tmp_path, monkeypatch):
    path = begun(tmp_path / "run", 1.0)
    read: list[object] = []

    def held_out(folder):
        read.append(folder)
        return {}

    monkeypatch.setattr(run_list, "held_out", held_out)
    monkeypatch.setattr(headline, "worth", lambda *_: f"reading {len(read)}")
    (path / "results").mkdir()
    (path / "results" / "online-1.parquet").touch()
    with contextlib.closing(RunList(tmp_path)) as runs:
        wait_for(lambda: runs.listed()["runs"][0]["held_out"] == "reading 1")
        time.sleep(0.1)
        assert len(read) == 1
        (path / "results" / "online-2.parquet").touch()
        wait_for(lambda: runs.listed()["runs"][0]["held_out"] == "reading 2")


def test_the_terminal_waits_for_the_first_run_and_changes_to_a_newer_one(tmp_path, monkeypatch, capsys):
    folder, shown = tmp_path / "runs", []

    def watch(feed, replaced):
        shown.append(feed.state.name)
        if len(shown) == 1:
            assert not replaced()
            begun(folder / "late", 3.0)
            assert not replaced(), "it has no learner yet"
            lock.enter_context(hold(folder / "late"))
            (folder / "late" / "endpoint").write_text("tcp/127.0.0.1:1")
            assert replaced()
            return None
        return 0

    @contextlib.contextmanager
    def open_run(run):
        feed = FakeFeed()
        feed.state._run["name"] = run.name
        yield feed

    class Waiting(Console):
        def print(self, *objects, **options):
            super().print(*objects, **options)
            begun(folder / "early", 1.0)

    monkeypatch.setattr(screen, "watch", watch)
    with contextlib.ExitStack() as lock:
        assert folder_module.watch(folder, open_run, Waiting(width=200)) == 0
    assert shown == ["early", "late"]
    assert capsys.readouterr().out.startswith(f"waiting for the first run in {folder}, which does not exist yet")


def test_the_command_tells_a_run_from_a_folder_of_runs(tmp_path):
    run = begun(tmp_path / "run", 1.0)
    assert command._holds_runs(tmp_path) and command._holds_runs(tmp_path / "later")
    assert not command._holds_runs(run) and not command._holds_runs(run / "run.toml")
    with open_feed(find(run)[0]) as feed:
        wait_for(lambda: feed.state.snapshot(feed.now())["run"]["state"] == "finished")


def test_a_recording_of_a_run_that_goes_on_is_opened_again(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_module, "_PERIOD_S", 30.0)
    path = begun(tmp_path / "run", 1.0)
    with hold(path), contextlib.closing(FolderViews(tmp_path, open_feed)) as views:
        first = views.watched("run")
        wait_for(lambda: known(first._feed.replay())["at"] == known(first._feed.replay())["end"])
        views.refresh()
        assert views.watched("run") is first, "only every ten seconds"
        first._opened -= 20.0
        views.refresh()
        assert views.watched("run") is first, "nothing new"
        os.utime(path / "metrics.jsonl", (5.0, 5.0))
        views.refresh()
        assert views.watched("run") is not first
