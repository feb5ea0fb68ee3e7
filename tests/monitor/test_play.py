"""The player of ``icrl-dist play``: its thread, its viewers, and refused command lines."""

import json
from threading import Event, Thread

import pytest

from icrl_dist.cli.main import main
from icrl_dist.config.run import dumps, load
from icrl_dist.monitor import player
from icrl_dist.monitor.event_stream import EventStream
from icrl_dist.monitor.player import Player
from tests.problems.darkroom.fixed_agent import Agent, game


class Recorded(EventStream):
    """A stream with one viewer; it records what is published."""

    viewers = 1

    def __init__(self):
        super().__init__()
        self.events = []

    def publish(self, event, data, state=False):
        super().publish(event, data, state)
        self.events.append((event, json.loads(json.dumps(data))))


def test_commands_of_viewers_are_carried_out_and_answered_by_the_thread_of_the_game(small_run, monkeypatch):
    monkeypatch.setattr(player, "FRAME_S", 0.0)
    monkeypatch.setattr(player, "BELIEF_S", 0.0)
    g, stream, over = game(small_run), Recorded(), Event()
    g.paused = True
    p = Player(g, stream)
    thread = Thread(target=p.run, args=(over,))
    thread.start()
    try:
        with pytest.raises(ValueError, match="p=7"):
            p.command({"do": "p", "value": 7})
        p.command({"do": "p", "value": 0.25})
        p.command({"do": "episode"})
        p.command({"do": "step"})
        p.command({"do": "pause", "value": True})
    finally:
        over.set()
        thread.join()
    events = [event for event, _ in stream.events]
    assert {"room", "belief", "episodes"} <= set(events)
    assert [data["p"] for event, data in stream.events if event == "room"][-1] == 0.25
    (belief, *_) = (data for event, data in stream.events if event == "belief")
    assert len(belief["implied"]) == len(belief["exact"]) == 9 and 0 <= belief["apart"] <= 1


def test_the_game_is_paused_without_viewers(small_run):
    g, stream, over = game(small_run), EventStream(), Event()
    p = Player(g, stream)
    thread = Thread(target=p.run, args=(over,))
    thread.start()
    p.command({"do": "episode"})
    p.command({"do": "p", "value": 0.5})
    over.set()
    thread.join()
    assert g.steps == 0 and g.p == 0.5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "play: name a run folder or a checkpoint file, or --pretrained darkroom"),
        (["here", "--pretrained", "darkroom"], "play: name a run folder"),
        (["--pretrained", "lightroom"], "no agent of that name in the package; there are darkroom"),
        (["nowhere"], "nowhere: no such run folder or checkpoint"),
        (["--pretrained", "darkroom", "--web", "99999"], "--web 99999: a port must be 0 (any free port) to 65535"),
        (["--pretrained", "darkroom", "--host", "nowhere.invalid"], "name an address of this machine"),
    ],
)
def test_arguments_that_cannot_be_played_are_refused_in_one_line(words, message, capsys):
    assert main(["play", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_problem_without_a_game_is_refused(monkeypatch, capsys):
    agent = Agent()
    agent.manifest = {"run": dumps(load("dmc-cheetah-run"))}
    monkeypatch.setattr(player, "load_agent", lambda *_: agent)
    assert main(["play", "runs/cheetah"]) == 2
    assert (
        "play runs/cheetah: its agent is for dmc-cheetah-run, which cannot be played; use an agent of darkroom"
        in capsys.readouterr().err
    )
