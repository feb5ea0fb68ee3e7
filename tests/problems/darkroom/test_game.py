"""The game of ``icrl-dist play`` without a server: what a person can do to an agent, and what is shown of it."""

import json
from threading import Event, Thread

import numpy as np
import pytest

from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.agent.loading import load_agent
from icrl_dist.cli.main import main
from icrl_dist.config.run import dumps, load, parse
from icrl_dist.monitor import player
from icrl_dist.monitor.player import Player
from icrl_dist.monitor.serve import EventStream
from icrl_dist.problems.darkroom.game import HELD_S, PlayGame
from icrl_dist.problems.darkroom.room import MOVES, cells
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns

RIGHT, LEFT, UP, DOWN, STAY = range(5)


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


class Agent(InContextAgent):
    """One that always does the same and remembers what it was told."""

    def __init__(self, action=UP, deploy="committed"):
        self.outcomes, self.action, self.deploy = None, action, deploy
        self.manifest, self.told, self.forgot = {"test_goals": [[2, 1]]}, [], 0

    def reset_context(self):
        self.told.clear()
        self.forgot += 1

    def act(self, observation):
        return np.array([self.action])

    def observe(self, *transition):
        self.told.append(tuple(np.asarray(column)[0] for column in transition))

    def law(self, states, row=0):
        return np.full((len(states), 5), 0.2)

    def context(self, row=0):
        ended = [i for i, t in enumerate(self.told) if t[4]]
        known = self.told if self.deploy == "committed" else self.told[: ended[-1] + 1 if ended else 0]
        before, action, reward, after = (np.array([t[i] for t in known]) for i in range(4))
        return before.reshape(-1, 2), action.astype(np.int64), after.reshape(-1, 2), reward


@pytest.fixture
def run(small_run):
    return small_run  # 3 x 3, 8 steps


def game(run, agent=None, seed=0, clock=None):
    return PlayGame(agent or Agent(), run, seed, clock or Clock())


def play(g, steps):
    for _ in range(steps):
        g.step()


def test_the_agent_is_told_what_came_of_its_own_action_and_no_more(run):
    g = game(run)
    g.command({"do": "goal", "value": [1, 0]})
    g.command({"do": "push", "value": RIGHT})
    play(g, 2)
    (before, action, reward, after, done), (_, _, second, end, _) = g.agent.told
    assert (before.tolist(), action, reward, after.tolist(), done) == ([0, 0], UP, 1, [1, 0], False)
    assert (second, end.tolist()) == (0, [1, 1])
    assert g.path == [(3, "hand"), (4, "agent")] and g.total == 1


def test_every_step_is_a_move_and_walls_stop_it(run):
    g = game(run)
    g.command({"do": "p", "value": 0.7})
    at = np.zeros(2)
    play(g, 7)
    for cell, _ in g.path:
        moved = [np.clip(at + move, 0, 2).tolist() for move in MOVES]
        at = cells(3)[cell]
        assert at.tolist() in moved


def test_the_law_overrides_as_often_and_with_what_it_says(run):
    g = game(run)
    g.command({"do": "p", "value": 0.4})
    g.command({"do": "law", "value": RIGHT})
    play(g, 8 * 200)
    share = sum(e.overridden for e in g.episodes) / (8 * len(g.episodes))
    assert abs(share - 0.4) < 0.05 and not any(e.by_hand for e in g.episodes)
    g.command({"do": "p", "value": 1})
    play(g, 8)
    assert [cell for cell, _ in g.path] == [3] + [6] * 7 and {cause for _, cause in g.path} == {"law"}


def test_a_hand_that_holds_goes_on_until_it_lets_go_or_is_lost(run):
    clock = Clock()
    g = game(run, clock=clock)
    g.command({"do": "hold", "value": STAY})
    play(g, 3)
    g.command({"do": "hold", "value": None})
    play(g, 1)
    g.command({"do": "hold", "value": STAY})
    clock.now += HELD_S / 2
    g.command({"do": "hold", "value": STAY})
    clock.now += HELD_S - 0.01
    play(g, 1)
    clock.now += 0.02
    play(g, 1)
    assert [cause for _, cause in g.path] == ["hand"] * 3 + ["agent", "hand", "agent"]


def test_a_short_tap_between_two_steps_is_not_lost(run):
    g = game(run)
    g.command({"do": "hold", "value": RIGHT})
    g.command({"do": "hold", "value": None})
    play(g, 2)
    assert [cause for _, cause in g.path] == ["hand", "agent"]


def test_the_optimum_is_the_oracles_for_this_goal_and_law(run):
    g = game(run)
    for p, law, q in ((0.0, None, [0.2] * 5), (0.5, None, [0.2] * 5), (0.5, LEFT, [0, 1, 0, 0, 0])):
        g.command({"do": "p", "value": p})
        g.command({"do": "law", "value": law})
        h = Hypotheses(3, 8, np.array([7]), np.array([p]), np.array([q], np.float64))
        assert g.optimum == pytest.approx(optimal_returns(h)[0])
    assert g.snapshot()["law"] == LEFT


def test_an_episode_in_which_the_task_changed_has_no_optimum(run):
    g = game(run)
    play(g, 3)
    g.command({"do": "p", "value": 0.5})
    play(g, 13)
    assert [e.optimum is None for e in g.episodes] == [True, False]
    g.command({"do": "goal", "value": [0, 0]})  # between two episodes
    play(g, 8)
    assert g.episodes[2].optimum == pytest.approx(g.optimum)


@pytest.mark.parametrize("keep", [False, True])
def test_a_goal_that_moves_is_another_task_unless_the_context_is_kept(run, keep):
    g = game(run, Agent(STAY))
    g.command({"do": "keep", "value": keep})
    forgot = g.agent.forgot
    play(g, 5)
    g.command({"do": "goal", "value": [0, 0]})
    assert g.agent.forgot == forgot + (not keep)
    play(g, 2)
    read = g.belief()
    assert read.transitions == (7 if keep else 2)
    assert read.exact[0] == pytest.approx(1), "the exact posterior is told of the move: it would be refuted"
    g.command({"do": "goal", "value": [0, 1]})
    assert g.belief().exact == pytest.approx(np.full(9, 1 / 9))


@pytest.mark.parametrize("deploy", ["paper", "committed"])
def test_the_exact_posterior_is_given_what_the_agents_context_holds(run, deploy):
    g = game(run, Agent(STAY, deploy))
    g.command({"do": "keep", "value": True})
    play(g, 12)
    g.command({"do": "goal", "value": [2, 2]})
    play(g, 2)
    known = {"paper": 0, "committed": 1}[deploy]
    assert (g.belief().exact > 0).sum() == 9 - known
    play(g, 2)
    assert (g.belief().exact > 0).sum() == 8 and g.belief().exact[0] == 0


def test_the_same_commands_between_the_same_steps_give_the_same_game():
    def played(seed):
        agent = load_agent("darkroom", seed=seed)
        g = PlayGame(agent, parse(agent.manifest["run"], "agent"), seed, Clock())
        g.command({"do": "p", "value": 0.3})
        play(g, 15)
        g.command({"do": "new"})
        play(g, 5)
        return g.path, g.snapshot()

    first, again, other = played(1), played(1), played(2)
    assert first == again and first[0] != other[0]
    assert len(first[0]) == 5 and first[1]["surprise"] is not None


def test_all_that_is_shown_is_json_and_stays_small(run):
    g = game(run, Agent(STAY))
    play(g, 8 * 405)
    history = g.history()
    assert history["first"] == 6 and len(history["total"]) == 400 and history["total"][-1] == 0
    assert len(json.dumps(history, allow_nan=False)) < 20_000
    room = g.snapshot()
    assert len(json.dumps(room, allow_nan=False)) < 2_000
    assert room["path"][0] == [0, "start"] and len(room["path"]) == 9 and room["optimum"] == pytest.approx(6)
    play(g, 1)
    assert g.history()["first"] == 6 and g.snapshot()["episode"] == 406


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "do='None': expected one of goal, p, law"),
        ({"do": "reset"}, "do='reset'"),
        ({"do": ["p"]}, "do="),
        ({"do": "p"}, "p: expected the fields do, value"),
        ({"do": "step", "value": 1}, "step: expected the fields do"),
        ({"do": "p", "value": 0.5, "more": 1}, "p: expected the fields"),
        *(({"do": "p", "value": v}, "a number from 0 to 1") for v in (-0.1, 1.1, "0.5", True, None, [0.5], 10**400)),
        *(
            ({"do": "goal", "value": v}, "expected [x, y], each 0 to 2")
            for v in ([3, 0], [0, -1], [0], "00", [0, 1.0], [True, 0], {})
        ),
        *(({"do": "push", "value": v}, "expected 0 to 4") for v in (-1, 5, 1.0, True, None, "up")),
        *(({"do": "hold", "value": v}, "expected 0 to 4") for v in (-1, 5, False)),
        *(({"do": "law", "value": v}, "expected 0 to 4") for v in (7, "uniform")),
        *(({"do": "speed", "value": v}, "a number from 0.5 to 100") for v in (0, 1000, None)),
        *(({"do": "pause", "value": v}, "expected true or false") for v in (0, 1, "true", None)),
        ({"do": "x" * 5000}, "do='xxxx"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_short_line_and_changes_nothing(run, fields, said):
    g = game(run)
    before = g.snapshot()
    with pytest.raises(ValueError) as error:
        g.command(fields)
    assert said in str(error.value) and len(str(error.value).splitlines()) == 1 and len(str(error.value)) < 200
    assert g.snapshot() == before


class Told(EventStream):
    """A stream that somebody looks at."""

    viewers = 1

    def __init__(self):
        super().__init__()
        self.told = []

    def publish(self, event, data, state=False):
        super().publish(event, data, state)
        self.told.append((event, json.loads(json.dumps(data))))


def test_one_thread_has_the_game_and_viewers_wait_for_its_answer(run, monkeypatch):
    monkeypatch.setattr(player, "FRAME_S", 0.0)
    monkeypatch.setattr(player, "BELIEF_S", 0.0)
    g, stream, over = game(run), Told(), Event()
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
    events = [event for event, _ in stream.told]
    assert {"room", "belief", "episodes"} <= set(events)
    assert [data["p"] for event, data in stream.told if event == "room"][-1] == 0.25
    (belief, *_) = (data for event, data in stream.told if event == "belief")
    assert len(belief["implied"]) == len(belief["exact"]) == 9 and 0 <= belief["apart"] <= 1


def test_nothing_moves_while_nobody_looks_on(run):
    g, stream, over = game(run), EventStream(), Event()
    p = Player(g, stream)
    thread = Thread(target=p.run, args=(over,))
    thread.start()
    p.command({"do": "episode"})
    p.command({"do": "p", "value": 0.5})
    over.set()
    thread.join()
    assert g.steps == 0 and g.p == 0.5


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "play: name a run folder or a checkpoint file, or --pretrained darkroom"),
        (["here", "--pretrained", "darkroom"], "play: name a run folder"),
        (["--pretrained", "lightroom"], "no agent of that name is shipped; there are darkroom"),
        (["nowhere"], "nowhere: no such run folder or checkpoint"),
        (["--pretrained", "darkroom", "--web", "99999"], "--web 99999: a port is 0 (any free one) to 65535"),
        (["--pretrained", "darkroom", "--host", "nowhere.invalid"], "name an address of this machine"),
    ],
)
def test_what_cannot_be_played_is_said_in_a_line(words, said, capsys):
    assert main(["play", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_only_a_dark_room_can_be_played(monkeypatch, capsys):
    agent = Agent()
    agent.manifest = {"run": dumps(load("dmc-cheetah-run"))}
    monkeypatch.setattr(player, "load_agent", lambda *_: agent)
    assert main(["play", "runs/cheetah"]) == 2
    assert "play runs/cheetah: its agent knows dmc-cheetah-run; only a Dark Room can be played" in capsys.readouterr().err
