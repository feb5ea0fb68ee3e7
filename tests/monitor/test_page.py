"""The server of the live view's page, without a browser: a full snapshot, then changes; single variations; recordings."""

import asyncio
import contextlib
import json
import re
from importlib import resources

import pytest

from icrl_dist.monitor import event_stream, serve
from icrl_dist.monitor import page as page_module
from icrl_dist.monitor.page import EVENT, SnapshotPublisher, serving_run
from icrl_dist.monitor.serve import application, serving
from tests.monitor.fake_feed import FakeFeed
from tests.monitor.test_serve import PageClient, wait_for

ASSETS = resources.files("icrl_dist.monitor") / "assets"


class Run(FakeFeed):
    """A feed that remembers since when pictures were asked for; ``tick`` is what the page's thread does."""

    def __init__(self):
        super().__init__()
        self.snapshots = []
        snapshot = self.state.snapshot
        self.state.snapshot = lambda now, since=-1: self.snapshots.append(since) or snapshot(now, since)

    def returned(self, variation, trial, earned):
        named = {"task": {"size": 3, "horizon": 8, "goal": [1, 1]}, "adversary": {"kind": "uniform", "p": 0.5}}
        columns = {"trials": [trial], "returns": [earned], "steps": [8], "policy_version": 0, "weights_digest": "d" * 64}
        told = {"identity": f"adapt/0/{variation}", "problem": "darkroom", **named, **columns}
        self.send("trajectories", worker="w0", variations=[told])

    def tick(self):
        self.pass_time(0.25)


class View:
    """What a page that follows docs/monitor.md knows."""

    def __init__(self, page):
        self.viewer, self.known, self.told = page.connect(), None, []

    def next(self):
        event, told = self.viewer.next()
        assert event == EVENT
        self.told.append(told)
        if told["since"] == -1:
            self.known = told
        else:
            assert told["epoch"] == self.known["epoch"] and told["since"] <= self.known["seq"]
            rows = {row["name"]: row for row in self.known["variations"]} | {row["name"]: row for row in told["variations"]}
            events = {e["number"]: e for e in (*self.known["events"], *told["events"])}
            self.known = {**told, "variations": list(rows.values()), "events": list(events.values())}
        return told

    def close(self):
        self.viewer.connection.close()
        self.viewer.response.close()


@pytest.fixture
def run():
    return Run()


@pytest.fixture
def page(run):
    publisher = SnapshotPublisher(run)
    routes = [serve.Route("/variation/{task}/{variation}", publisher.variation)]
    app = application("monitor.html", publisher.stream, publisher.command, routes)
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(serving(app, publisher.stream, "127.0.0.1", 0))
        page = PageClient(url, publisher.stream, None)
        page.publish = publisher.publish

        def view():
            views = page.stream.viewers
            one = View(page)
            stack.callback(one.close)
            wait_for(lambda: page.stream.viewers == views + 1)
            return one

        page.view = view
        yield page


def test_a_viewer_is_told_the_whole_and_then_only_what_changed(run, page):
    run.returned("0/0", 0, 1.0)
    run.returned("0/1", 0, 2.0)
    run.send("event", what="version", text="T^0 is fitted", version=0)
    run.tick()
    view = page.view()
    whole = view.next()
    assert whole["since"] == -1 and whole["replay"] is None
    assert [row["name"] for row in whole["variations"]] == ["0/0", "0/1"] and len(whole["events"]) == 1
    run.returned("0/1", 1, 3.0)
    run.send("event", what="version", text="T^1 is fitted", version=1)
    run.tick()
    page.publish()
    delta = view.next()
    assert (delta["since"], delta["seq"]) == (whole["seq"], whole["seq"] + 1)
    assert [event["text"] for event in delta["events"]] == ["T^1 is fitted"]
    assert delta["run"]["version"] == 1
    (phase,) = delta["variations"][-1]["phases"]
    assert (phase["name"], phase["trials"], phase["returns"]) == ("adapt/0", [0, 1], [2.0, 3.0])
    run.tick()
    page.publish()
    assert not view.next()["variations"]


def test_all_viewers_know_the_same_whenever_they_came(run, page):
    run.returned("0/0", 0, 1.0)
    run.tick()
    first = page.view()
    first.next()
    for trial in range(1, 5):
        run.returned("0/0", trial, float(trial))
        run.tick()
        page.publish()
    for _ in range(4):
        first.next()
    late = page.view()
    late.next()
    run.returned("1/0", 0, 9.0)
    run.tick()
    page.publish()
    first.next()
    late.next()
    run.snapshots.clear()
    assert first.known == late.known
    assert {row["name"] for row in first.known["variations"]} == {"0/0", "1/0"}


def test_a_tick_is_computed_once_for_all(run, page):
    run.tick()
    views = [page.view() for _ in range(3)]
    for view in views:
        assert view.next()["since"] == -1
    assert run.snapshots == [-1]
    run.tick()
    page.publish()
    told = [view.next() for view in views]
    assert told[0] == told[1] == told[2] and run.snapshots == [-1, told[0]["since"]]


def test_nothing_is_computed_for_nobody_and_who_returns_begins_anew(run, page):
    run.tick()
    page.publish()
    assert run.snapshots == []
    first = page.view()
    before = first.next()
    first.close()
    # A lost viewer is noticed when it is told something.
    wait_for(lambda: (run.tick(), page.publish(), page.stream.viewers == 0)[-1])
    run.snapshots.clear()
    run.returned("0/0", 0, 1.0)
    run.tick()
    page.publish()
    assert run.snapshots == []
    again = page.view()
    whole = again.next()
    assert whole["since"] == -1 and whole["epoch"] == before["epoch"] and len(whole["variations"]) == 1


def test_what_cannot_be_told_is_logged_once_and_the_next_change_is_told(run, monkeypatch, caplog):
    monkeypatch.setattr(page_module, "PUSH_S", 0.01)
    with serving_run(run, "127.0.0.1", 0) as url:
        view = View(PageClient(url, None, None))
        view.next()
        whole, asked = run.state.snapshot, []
        broken = lambda now, since=-1: asked.append(since) or {**whole(now, since), "time": float("nan")}  # noqa: E731
        monkeypatch.setattr(run.state, "snapshot", broken)
        run.send("event", what="note", text="told in the end")
        run.tick()
        wait_for(lambda: len(asked) > 3)
        monkeypatch.setattr(run.state, "snapshot", whole)
        while "told in the end" not in [event["text"] for event in view.known["events"]]:
            view.next()
        view.close()
    assert [record.exc_info[0] for record in caplog.records] == [ValueError]


def test_what_is_forgotten_is_forgotten_by_all(run, page):
    run.returned("0/0", 0, 1.0)
    run.tick()
    views = [page.view(), page.view()]
    for view in views:
        view.next()
    run.state.clear()  # a recording is wound back
    run.tick()
    page.publish()
    for view in views:
        told = view.next()
        assert told["since"] == -1 and told["variations"] == [] and told["epoch"] != view.told[0]["epoch"]


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
        return [[line[6:] for line in chunk.decode().splitlines() if line.startswith("data: ")] for chunk in received]

    changes = [f"change {number}" for number in range(event_stream.MAX_BEHIND)]
    # A change may be in the full snapshot and be sent after it again: applying it twice has no effect.
    assert asyncio.run(receive_late()) == [["full 0"], changes, ["full 1"], ["change 17", "change 18"]]


def test_a_variation_can_be_asked_for(run, page):
    run.returned("3/1", 0, 1.5)
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


def test_a_recording_is_stopped_hurried_and_wound(run, page):
    assert page.command('{"paused": true}') == (
        400,
        '{"error":"this run is on: only a recording can be stopped, hurried or wound"}',
    )
    run.recording = {"begin": 1.0, "end": 9.0, "at": 2.0, "speed": 10.0, "paused": False}
    orders = [{"paused": True}, {"speed": 2.5}, {"at": 4, "paused": False}]
    for order in orders:
        assert page.command(json.dumps(order)) == (204, "")
    for bad in ({"paused": 1}, {"speed": "fast"}, {"speed": 0}, {"speed": True}, {"at": None}, {"at": -1}, {"stop": 1}):
        status, text = page.command(json.dumps(bad))
        assert status == 400 and next(iter(bad)) in json.loads(text)["error"]
    assert run.controls == orders
    run.tick()
    assert page.view().next()["replay"] == run.recording


def test_the_page_tells_by_itself_and_ends(run):
    with serving_run(run, "127.0.0.1", 0) as url:
        view = View(PageClient(url, None, None))
        assert view.next()["since"] == -1
        run.tick()
        assert view.next()["since"] >= 0  # nobody called tell
    while view.viewer.next() is not None:
        pass
    view.close()


def test_the_page_needs_nothing_but_what_is_served_and_no_markup_from_data(page):
    status, headers, html = page.request("GET", "/")
    text = html.decode()
    assert status == 200 and headers["content-type"].startswith("text/html")
    assert not re.search(r"<script(?![^>]*\bsrc=)|\bstyle=|<style|\bon\w+=|https?://", text)
    wanted = set(re.findall(r'(?:href|src)="([^"#]+)"', text))
    scripts = [file for file in ASSETS.iterdir() if file.name.startswith(("monitor", "common")) and file.name.endswith(".js")]
    for script in scripts:
        code = script.read_text()
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function", code), script.name
        wanted |= {f"/assets/{name}" for name in re.findall(r'from "\./([^"]+)"', code)}
    for path in wanted:
        assert page.request("GET", path)[0] == 200, path
    ids = set(re.findall(r'\bid="([^"]+)"', text))
    asked = {one for script in scripts for one in re.findall(r'byId\("([^"]+)"\)', script.read_text())}
    assert asked and asked <= ids
