"""The server of the live view's page, without a browser: a full snapshot, then changes; single variations; recordings."""

import asyncio
import contextlib
import json
import re
from importlib import resources
from typing import Any

import pytest
from starlette.routing import Route

from icrl_dist.monitor import event_stream
from icrl_dist.monitor import page as page_module
from icrl_dist.monitor.page import EVENT, SnapshotPublisher, serving_run
from icrl_dist.monitor.run_state import RunState
from icrl_dist.monitor.serve import application, serving
from tests.monitor.fake_feed import FakeFeed
from tests.monitor.test_serve import PageClient, wait_for
from tests.optional import known

ASSETS = resources.files("icrl_dist.monitor") / "assets"


class CountingState(RunState):
    """A run state that records the `since` of every snapshot."""

    def __init__(self, snapshots):
        super().__init__("demo")
        self._snapshots = snapshots

    def snapshot(self, now, since=-1):
        self._snapshots.append(since)
        return super().snapshot(now, since)


class CountingFeed(FakeFeed):
    """A feed that records the `since` of every snapshot."""

    def __init__(self):
        super().__init__()
        self.snapshots: list[int] = []
        self.state = CountingState(self.snapshots)

    def send_return(self, variation, trial, total):
        variation_info = {"task": {"size": 3, "horizon": 8, "goal": [1, 1]}, "adversary": {"kind": "uniform", "p": 0.5}}
        columns = {"trials": [trial], "returns": [total], "steps": [8], "policy_version": 0, "weights_digest": "d" * 64}
        entry = {"identity": f"adapt/0/{variation}", "problem": "darkroom", **variation_info, **columns}
        self.send("trajectories", worker="w0", variations=[entry])

    def tick(self):
        self.pass_time(0.25)


class View:
    """A viewer that applies the events as docs/monitor.md describes."""

    def __init__(self, page):
        self.viewer, self.snapshots = page.connect(), []
        self.state: dict[str, Any] = {}

    def next(self):
        event, snapshot = self.viewer.next()
        assert event == EVENT
        self.snapshots.append(snapshot)
        if snapshot["since"] == -1:
            self.state = snapshot
        else:
            assert snapshot["epoch"] == self.state["epoch"] and snapshot["since"] <= self.state["seq"]
            rows = {row["name"]: row for row in self.state["variations"]} | {row["name"]: row for row in snapshot["variations"]}
            events = {e["number"]: e for e in (*self.state["events"], *snapshot["events"])}
            self.state = {**snapshot, "variations": list(rows.values()), "events": list(events.values())}
        return snapshot

    def close(self):
        self.viewer.connection.close()
        self.viewer.response.close()


@pytest.fixture
def run():
    return CountingFeed()


class Page(PageClient):
    """The page of a feed, which publishes when a test calls ``publish``."""

    def __init__(self, url, publisher, stack):
        super().__init__(url, publisher.stream, None)
        self.publish, self._stack = publisher.publish, stack

    def view(self):
        """A new viewer, which the page knows."""
        views = self.stream.viewers
        one = View(self)
        self._stack.callback(one.close)
        wait_for(lambda: self.stream.viewers == views + 1)
        return one


@pytest.fixture
def page(run):
    publisher = SnapshotPublisher(run)
    routes = [Route("/variation/{task}/{variation}", publisher.variation)]
    app = application("monitor.html", publisher.stream, publisher.command, routes)
    with contextlib.ExitStack() as stack:
        yield Page(stack.enter_context(serving(app, publisher.stream, "127.0.0.1", 0)), publisher, stack)


def test_a_viewer_receives_a_full_snapshot_and_then_only_changes(run, page):
    run.send_return("0/0", 0, 1.0)
    run.send_return("0/1", 0, 2.0)
    run.send("event", what="version", text="T^0 is fitted", version=0)
    run.tick()
    view = page.view()
    full = view.next()
    assert full["since"] == -1 and full["replay"] is None
    assert [row["name"] for row in full["variations"]] == ["0/0", "0/1"] and len(full["events"]) == 1
    run.send_return("0/1", 1, 3.0)
    run.send("event", what="version", text="T^1 is fitted", version=1)
    run.tick()
    page.publish()
    delta = view.next()
    assert (delta["since"], delta["seq"]) == (full["seq"], full["seq"] + 1)
    assert [event["text"] for event in delta["events"]] == ["T^1 is fitted"]
    assert delta["run"]["version"] == 1
    (phase,) = delta["variations"][-1]["phases"]
    assert (phase["name"], phase["trials"], phase["returns"]) == ("adapt/0", [0, 1], [2.0, 3.0])
    run.tick()
    page.publish()
    assert not view.next()["variations"]


def test_early_and_late_viewers_have_the_same_state(run, page):
    run.send_return("0/0", 0, 1.0)
    run.tick()
    first = page.view()
    first.next()
    for trial in range(1, 5):
        run.send_return("0/0", trial, float(trial))
        run.tick()
        page.publish()
    for _ in range(4):
        first.next()
    late = page.view()
    late.next()
    run.send_return("1/0", 0, 9.0)
    run.tick()
    page.publish()
    first.next()
    late.next()
    run.snapshots.clear()
    assert first.state == late.state
    assert {row["name"] for row in first.state["variations"]} == {"0/0", "1/0"}


def test_a_change_is_computed_once_for_all_viewers(run, page):
    run.tick()
    views = [page.view() for _ in range(3)]
    for view in views:
        assert view.next()["since"] == -1
    assert run.snapshots == [-1]
    run.tick()
    page.publish()
    snapshot = [view.next() for view in views]
    assert snapshot[0] == snapshot[1] == snapshot[2] and run.snapshots == [-1, snapshot[0]["since"]]


def test_no_snapshot_is_computed_without_viewers_and_a_new_viewer_gets_a_full_one(run, page):
    run.tick()
    page.publish()
    assert run.snapshots == []
    first = page.view()
    before = first.next()
    first.close()
    # The server notices a closed connection when it sends something.
    wait_for(lambda: (run.tick(), page.publish(), page.stream.viewers == 0)[-1])
    run.snapshots.clear()
    run.send_return("0/0", 0, 1.0)
    run.tick()
    page.publish()
    assert run.snapshots == []
    later = page.view()
    full = later.next()
    assert full["since"] == -1 and full["epoch"] == before["epoch"] and len(full["variations"]) == 1


def test_a_snapshot_that_fails_is_logged_once_and_the_next_one_is_sent(run, monkeypatch, caplog):
    monkeypatch.setattr(page_module, "PUSH_S", 0.01)
    with serving_run(run, "127.0.0.1", 0) as url:
        view = View(PageClient(url, None, None))
        view.next()
        full, calls = run.state.snapshot, list[int]()

        def broken(now, since=-1):
            calls.append(since)
            return {**full(now, since), "time": float("nan")}

        monkeypatch.setattr(run.state, "snapshot", broken)
        run.send("event", what="note", text="sent in the end")
        run.tick()
        wait_for(lambda: len(calls) > 3)
        monkeypatch.setattr(run.state, "snapshot", full)
        while "sent in the end" not in [event["text"] for event in view.state["events"]]:
            view.next()
        view.close()
    assert [record.exc_info[0] for record in caplog.records] == [ValueError]


def test_after_clear_all_viewers_start_again(run, page):
    run.send_return("0/0", 0, 1.0)
    run.tick()
    views = [page.view(), page.view()]
    for view in views:
        view.next()
    run.state.clear()  # as after seeking back in a recording
    run.tick()
    page.publish()
    for view in views:
        snapshot = view.next()
        assert snapshot["since"] == -1 and snapshot["variations"] == [] and snapshot["epoch"] != view.snapshots[0]["epoch"]


def test_a_viewer_that_fell_behind_restarts_from_a_full_snapshot():
    async def receive_late():
        snapshots = iter(range(10))
        viewer = event_stream._Viewer(asyncio.get_running_loop(), lambda: ("picture", f"full {next(snapshots)}"))

        def put(count):
            for number in range(count):
                viewer.put("picture", event_stream._encoded("picture", f"change {number}"), False)

        received = [await viewer.next()]
        put(event_stream.MAX_BEHIND)
        received.append(await viewer.next())
        put(event_stream.MAX_BEHIND + 3)
        received += [await viewer.next(), await viewer.next()]
        return [[line[6:] for line in known(chunk).decode().splitlines() if line.startswith("data: ")] for chunk in received]

    changes = [f"change {number}" for number in range(event_stream.MAX_BEHIND)]
    # A change may be in the full snapshot and be sent after it later: applying it twice has no effect.
    assert asyncio.run(receive_late()) == [["full 0"], changes, ["full 1"], ["change 17", "change 18"]]


def test_the_details_of_a_variation_are_served(run, page):
    run.send_return("3/1", 0, 1.5)
    run.tick()
    status, headers, body = page.request("GET", "/variation/3/1")
    detail = json.loads(body)
    assert status == 200 and headers["content-type"] == "application/json"
    assert detail["adversary"] == {"kind": "uniform", "p": 0.5} and detail["episode"] is None
    (made,) = detail["lineage"]
    assert (made["identity"], made["worker"], made["policy_version"], made["weights_digest"]) == (
        "adapt/0/3/1/0",
        "w0",
        0,
        "d" * 64,
    )
    for name in ("3/2", "3", "3/1/0", "a/b", "-3/1", "3/%31%2f..", "9" * 30 + "/0", "%C2%B2/0"):
        assert page.request("GET", f"/variation/{name}")[0] == 404, name


def test_commands_pause_speed_up_and_seek_in_a_recording(run, page):
    assert page.command('{"paused": true}') == (
        400,
        '{"error":"this run is live: only a recording has pause, speed and seek"}',
    )
    run.recording = {"begin": 1.0, "end": 9.0, "at": 2.0, "speed": 10.0, "paused": False}
    commands = [{"paused": True}, {"speed": 2.5}, {"at": 4, "paused": False}]
    for command in commands:
        assert page.command(json.dumps(command)) == (204, "")
    for bad in ({"paused": 1}, {"speed": "fast"}, {"speed": 0}, {"speed": True}, {"at": None}, {"at": -1}, {"stop": 1}):
        status, text = page.command(json.dumps(bad))
        assert status == 400 and next(iter(bad)) in json.loads(text)["error"]
    assert run.controls == commands
    run.tick()
    assert page.view().next()["replay"] == run.recording


def test_the_page_publishes_by_itself_and_ends(run):
    with serving_run(run, "127.0.0.1", 0) as url:
        view = View(PageClient(url, None, None))
        assert view.next()["since"] == -1
        run.tick()
        assert view.next()["since"] >= 0  # the page's own thread published it
    while view.viewer.next() is not None:
        pass
    view.close()


def test_the_page_uses_only_its_own_files_and_makes_no_markup_from_data(page):
    status, headers, html = page.request("GET", "/")
    text = html.decode()
    assert status == 200 and headers["content-type"].startswith("text/html")
    assert not re.search(r"<script(?![^>]*\bsrc=)|\bstyle=|<style|\bon\w+=|https?://", text)
    paths = set(re.findall(r'(?:href|src)="([^"#]+)"', text))
    scripts = [file for file in ASSETS.iterdir() if file.name.startswith(("monitor", "common")) and file.name.endswith(".js")]
    for script in scripts:
        code = script.read_text()
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function", code), script.name
        paths |= {f"/assets/{name}" for name in re.findall(r'from "\./([^"]+)"', code)}
    for path in paths:
        assert page.request("GET", path)[0] == 200, path
    ids = set(re.findall(r'\bid="([^"]+)"', text))
    calls = {one for script in scripts for one in re.findall(r'byId\("([^"]+)"\)', script.read_text())}
    assert calls and calls <= ids
