"""A run from its folder: the picture at the end is that of the run as it was watched."""

import contextlib
import json
import os
import time

import pytest

from icrl_dist.cli.main import main
from icrl_dist.config.run import ConfigError
from icrl_dist.launch import train
from icrl_dist.monitor import page
from icrl_dist.monitor.feed import LiveFeed, ReplayFeed
from icrl_dist.monitor.picture import Picture
from icrl_dist.monitor.recording import Recording
from icrl_dist.storage import files
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream.memory_link import MemoryLink
from icrl_dist.stream.zenoh_link import ZenohLink
from learner import service
from tests.monitor.messages import progress
from tests.monitor.watched import run_folder

METRICS = service.Metrics


@pytest.fixture(scope="module")
def watched(module_run, tmp_path_factory):
    """A finished run in its folder, and what was published on its monitor plane."""
    folder = tmp_path_factory.mktemp("runs") / "watched"
    heard = []
    publish = MemoryLink.publish

    def listen(link, key, payload, droppable):
        if "/mon/" in key:
            heard.append((key, payload))
        publish(link, key, payload, droppable)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "Metrics", lambda folder, **options: METRICS(folder, tensorboard=False, **options))
        patch.setattr(MemoryLink, "publish", listen)
        train.prepare(module_run, folder, resume=False, overwrite=False)
        train.train_inline(module_run, folder, lambda event: None)
    return folder, heard


def played(folder):
    picture = Picture()
    recording = Recording(folder)
    for now, key, payload in recording.messages():
        picture.hear(key, payload, now)
    picture.tick(recording.end)
    recording.close()
    return picture, recording


def test_it_ends_in_the_picture_that_was_seen_live(watched):
    folder, heard = watched
    live = Picture(folder.name)
    for key, payload in heard:
        live.hear(key, payload, 0.0)
    live.tick(0.0)
    again, recording = played(folder)
    assert not live.ignored and not again.ignored
    seen, shown = live.snapshot(0.0), again.snapshot(recording.end)
    names = ("name", "phases", "adversary", "parameters")
    assert [{n: row[n] for n in names} for row in shown["variations"]] == [
        {n: row[n] for n in names} for row in seen["variations"]
    ]
    assert len(shown["variations"]) == shown["run"]["variations"] == seen["run"]["variations"] == 7 * 3
    for name in ("method", "problem", "rounds", "version", "trajectories", "state", "tasks"):
        assert shown["run"][name] == seen["run"][name], name
    assert [e["text"] for e in shown["events"] if e["what"] == "version"] == [
        e["text"] for e in seen["events"] if e["what"] == "version"
    ]
    assert shown["run"]["state"] == "finished" and shown["run"]["version"] == 2


def test_its_messages_are_in_order_of_time_and_within_the_run(watched):
    folder, _ = watched
    recording = Recording(folder)
    times = [now for now, _, _ in recording.messages()]
    assert times == sorted(times) and recording.begin <= times[0] and times[-1] <= recording.end
    store = Dataset(folder / "dataset", readonly=True)
    assert sum("/mon/trajectories/" in key for _, key, _ in recording.messages()) == len(store)
    store.close()
    recording.close()


def test_it_is_played_at_any_speed_paused_and_wound_back(watched):
    folder, _ = watched

    def until(condition):
        deadline = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.02)

    with ReplayFeed(folder, speed=1e4) as feed:
        until(lambda: feed.picture.snapshot(0.0)["run"]["state"] == "finished")
        where, epoch = feed.replay(), feed.picture.epoch
        assert where["at"] == where["end"] and feed.now() == where["end"]
        feed.control(paused=True)
        feed.control(at=where["begin"])
        until(lambda: feed.picture.epoch != epoch)
        until(lambda: feed.picture.snapshot(0.0)["run"]["state"] != "finished")
        assert feed.replay()["at"] == where["begin"] and feed.replay()["paused"]
        feed.control(speed=1e9, paused=False)
        until(lambda: feed.picture.snapshot(0.0)["run"]["state"] == "finished")
        assert feed.replay()["speed"] == 1e4


def test_a_torn_line_and_a_crashed_run_are_played_as_far_as_they_go(watched, tmp_path):
    folder, _ = watched
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    (crashed / "run.toml").write_text((folder / "run.toml").read_text())
    (crashed / "dataset").symlink_to(folder / "dataset")
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    (crashed / "metrics.jsonl").write_text("\n".join(lines[:4]) + '\n{"time": 1.5, "sta')
    picture, recording = played(crashed)
    shown = picture.snapshot(recording.end)
    assert shown["run"]["state"] != "finished" and len(shown["variations"]) == 21
    assert json.dumps(shown)


def test_a_folder_with_nothing_to_play_says_so(tmp_path, watched):
    folder, _ = watched
    with pytest.raises(ConfigError, match=r"not a run folder \(no run.toml\)"):
        Recording(tmp_path)
    (tmp_path / "run.toml").write_text((folder / "run.toml").read_text())
    with pytest.raises(ConfigError, match="nothing to play"):
        Recording(tmp_path)


def test_a_live_feed_hears_what_is_published(hub):
    link = hub()
    with LiveFeed(hub()) as feed, LiveFeed(hub(), "other") as other:
        link.publish("icrl/demo/mon/learner", progress(), droppable=True)
        deadline = time.monotonic() + 10
        while name_in(feed.picture) != "demo":
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert feed.replay() is None and other.picture.heard == 0
        feed.control(speed=2.0, paused=True, at=0.0)


def name_in(picture):
    return picture.snapshot(0.0)["run"]["name"]


@pytest.mark.parametrize("link", [False, True])
@pytest.mark.parametrize(("endpoint", "there"), [(False, False), (True, False), (True, True)])
def test_a_folder_is_watched_while_its_learner_holds_it_and_played_when_it_is_gone(
    hub, tmp_path, monkeypatch, capsys, endpoint, there, link
):
    folder, feeds = run_folder(tmp_path / "night"), []
    if link:
        (tmp_path / "latest").symlink_to("night")
    if endpoint:
        (folder / "endpoint").write_text("tcp/127.0.0.1:1\n")
    monkeypatch.setattr(ZenohLink, "connect", lambda *_: hub())
    monkeypatch.setattr(
        page, "serve", lambda feed, *_: feeds.append((type(feed), feed.picture.snapshot(0.0)["run"]["name"])) or 0
    )
    with files.hold(folder) if there else contextlib.nullcontext():
        assert main(["monitor", str(tmp_path / ("latest" if link else "night")), "--web", "0"]) == 0
    ((kind, name),) = feeds
    assert kind is (LiveFeed if there else ReplayFeed)
    assert name in (("" if link else "night") if there else ("", "latest", "night"))
    assert ("its learner is gone" in capsys.readouterr().out) == (endpoint and not there)


def test_without_a_folder_the_newest_run_is_meant_whose_learner_lives(hub, tmp_path, monkeypatch):
    found = []
    for number, name in enumerate(("older", "crashed")):
        folder = run_folder(tmp_path / "runs" / name)
        (folder / "endpoint").write_text(f"tcp/127.0.0.1:{number}\n")
        os.utime(folder / "endpoint", (1000.0 + number, 1000.0 + number))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ZenohLink, "connect", lambda endpoint, *_: found.append(endpoint) or hub())
    monkeypatch.setattr(page, "serve", lambda feed, *_: found.append(name_in(feed.picture)) or 0)
    with files.hold(tmp_path / "runs" / "older"):
        assert main(["monitor", "--web", "0"]) == 0
    assert main(["monitor", "--web", "0"]) == 0
    assert found == ["tcp/127.0.0.1:0", "older", "tcp/127.0.0.1:1", "crashed"]
