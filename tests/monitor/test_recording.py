"""Recordings: the run state at the end equals that of the live run; which feed `icrl-dist monitor` uses."""

import contextlib
import json
import os
import shutil
import time

import pytest

from icrl_dist.cli.main import main
from icrl_dist.config.run import ConfigError
from icrl_dist.launch import train
from icrl_dist.monitor import page
from icrl_dist.monitor.feed import LiveFeed, ReplayFeed
from icrl_dist.monitor.recording import Recording
from icrl_dist.monitor.run_state import RunState
from icrl_dist.storage import files
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream.memory_link import MemoryLink
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry.metrics import Metrics
from learner import service
from tests.calls import noting
from tests.monitor.fake_feed import BEGAN, run_folder
from tests.monitor.messages import progress
from tests.optional import known


@pytest.fixture(scope="module")
def finished(module_run, tmp_path_factory):
    """The folder of a finished run and the messages of its monitor plane."""
    folder = tmp_path_factory.mktemp("runs") / "watched"
    messages = []
    publish = MemoryLink.publish

    def listen(link, key, payload, droppable):
        if "/mon/" in key:
            messages.append((key, payload))
        publish(link, key, payload, droppable)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "Metrics", lambda folder, **options: Metrics(folder, tensorboard=False, **options))
        patch.setattr(MemoryLink, "publish", listen)
        train.prepare(module_run, folder, resume=False, overwrite=False)
        train.train_inline(module_run, folder, lambda event: None)
    return folder, messages


def played(folder):
    state = RunState()
    recording = Recording(folder)
    for now, key, payload in recording.messages():
        state.receive(key, payload, now)
    state.tick(recording.end)
    recording.close()
    return state, recording


def test_a_recording_ends_in_the_state_of_the_live_run(finished):
    folder, messages = finished
    live = RunState(folder.name)
    for key, payload in messages:
        live.receive(key, payload, 0.0)
    live.tick(0.0)
    replayed, recording = played(folder)
    assert not live.ignored and not replayed.ignored
    expected, shown = live.snapshot(0.0), replayed.snapshot(recording.end)
    names = ("name", "phases", "adversary", "parameters")
    assert [{n: row[n] for n in names} for row in shown["variations"]] == [
        {n: row[n] for n in names} for row in expected["variations"]
    ]
    assert len(shown["variations"]) == shown["run"]["variations"] == expected["run"]["variations"] == 7 * 3
    for name in ("method", "problem", "rounds", "version", "trajectories", "state", "tasks"):
        assert shown["run"][name] == expected["run"][name], name
    assert [e["text"] for e in shown["events"] if e["what"] == "version"] == [
        e["text"] for e in expected["events"] if e["what"] == "version"
    ]
    assert shown["run"]["state"] == "finished" and shown["run"]["version"] == 2


def test_messages_are_in_order_of_time_and_within_the_run(finished):
    folder, _ = finished
    recording = Recording(folder)
    times = [now for now, _, _ in recording.messages()]
    assert times == sorted(times) and recording.begin <= times[0] and times[-1] <= recording.end
    store = Dataset(folder / "dataset", readonly=True)
    assert sum("/mon/trajectories/" in key for _, key, _ in recording.messages()) == len(store)
    store.close()
    recording.close()


def test_speed_pause_and_seek_of_a_recording(finished):
    folder, _ = finished

    def until(condition):
        deadline = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.02)

    with ReplayFeed(folder, speed=1e4) as feed:
        until(lambda: feed.state.snapshot(0.0)["run"]["state"] == "finished")
        where, epoch = known(feed.replay()), feed.state.epoch
        assert where["at"] == where["end"] and feed.now() == where["end"]
        feed.control(paused=True)
        feed.control(at=where["begin"])
        until(lambda: feed.state.epoch != epoch)
        until(lambda: feed.state.snapshot(0.0)["run"]["state"] != "finished")
        there = known(feed.replay())
        assert there["at"] == where["begin"] and there["paused"]
        feed.control(speed=1e9, paused=False)
        until(lambda: feed.state.snapshot(0.0)["run"]["state"] == "finished")
        assert known(feed.replay())["speed"] == 1e4


def test_a_crashed_run_with_a_torn_last_line_is_played_to_its_end(finished, tmp_path):
    folder, _ = finished
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    (crashed / "run.toml").write_text((folder / "run.toml").read_text())
    shutil.copytree(folder / "dataset", crashed / "dataset")
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    (crashed / "metrics.jsonl").write_text("\n".join(lines[:4]) + '\n{"time": 1.5, "sta')
    state, recording = played(crashed)
    shown = state.snapshot(recording.end)
    assert shown["run"]["state"] != "finished" and len(shown["variations"]) == 21
    assert json.dumps(shown)


def test_a_folder_with_nothing_to_play_is_refused(tmp_path, finished):
    folder, _ = finished
    with pytest.raises(ConfigError, match=r"not a run folder \(no run.toml\)"):
        Recording(tmp_path)
    (tmp_path / "run.toml").write_text((folder / "run.toml").read_text())
    with pytest.raises(ConfigError, match="nothing to play"):
        Recording(tmp_path)


def test_a_live_feed_receives_the_messages_of_its_run(hub):
    link = hub()
    with LiveFeed(hub()) as feed, LiveFeed(hub(), "other") as other:
        link.publish("icrl/demo/mon/learner", progress(), droppable=True)
        deadline = time.monotonic() + 10
        while run_name(feed.state) != "demo":
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert feed.replay() is None and other.state.received == 0
        feed.control(speed=2.0, paused=True, at=0.0)


def run_name(state):
    return state.snapshot(0.0)["run"]["name"]


@pytest.mark.parametrize("link", [False, True])
@pytest.mark.parametrize(("endpoint", "held"), [(False, False), (True, False), (True, True)])
def test_a_folder_is_live_while_its_learner_holds_its_lock_and_a_recording_after(
    hub, tmp_path, monkeypatch, capsys, endpoint, held, link
):
    folder, feeds = run_folder(tmp_path / "night"), []
    if link:
        (tmp_path / "latest").symlink_to("night")
    if endpoint:
        (folder / "endpoint").write_text("tcp/127.0.0.1:1\n")
    monkeypatch.setattr(ZenohLink, "connect", lambda *_: hub())

    def serve(feed, *_):
        feeds.append((type(feed), feed.state.snapshot(0.0)["run"]["name"]))
        return 0

    monkeypatch.setattr(page, "serve", serve)
    with files.hold(folder) if held else contextlib.nullcontext():
        assert main(["monitor", str(tmp_path / ("latest" if link else "night")), "--web", "0"]) == 0
    ((kind, name),) = feeds
    assert kind is (LiveFeed if held else ReplayFeed)
    assert name in (("" if link else "night") if held else ("", "latest", "night"))
    assert ("no learner is running here" in capsys.readouterr().out) == (endpoint and not held)


def test_without_a_folder_the_newest_run_with_a_live_learner_is_shown(hub, tmp_path, monkeypatch):
    found = list[str]()
    for number, name in enumerate(("older", "crashed")):
        folder = run_folder(tmp_path / "runs" / name)
        (folder / "endpoint").write_text(f"tcp/127.0.0.1:{number}\n")
        os.utime(folder / "endpoint", (1000.0 + number, 1000.0 + number))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ZenohLink, "connect", noting(found, lambda endpoint, *_: endpoint, lambda *_: hub()))
    monkeypatch.setattr(page, "serve", noting(found, lambda feed, *_: run_name(feed.state), lambda *_: 0))
    with files.hold(tmp_path / "runs" / "older"):
        assert main(["monitor", "--web", "0"]) == 0
    assert main(["monitor", "--web", "0"]) == 0
    assert found == ["tcp/127.0.0.1:0", "older", "tcp/127.0.0.1:1", "crashed"]


def test_rollouts_of_new_weights_are_played_after_their_fit(tmp_path):
    recording = Recording(run_folder(tmp_path / "run"))
    try:
        messages = [(at - BEGAN, payload) for at, key, payload in recording.messages() if "/trajectories/" in key]
    finally:
        recording.close()
    assert len(messages) == 72
    assert max(at for at, payload in messages if b"pretrain/" in payload) <= 2
    assert min(at for at, payload in messages if b"adapt/" in payload) > 6
