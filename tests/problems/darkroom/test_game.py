"""The game of ``icrl-dist play`` without a server: the commands of a viewer, and what the page receives."""

import json
from typing import Any

import numpy as np
import pytest

from icrl_dist.agent.loading import load_agent
from icrl_dist.config.run import parse
from icrl_dist.problems.darkroom.game import HELD_S, PlayGame
from icrl_dist.problems.darkroom.room import MOVES, cells
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns
from tests.problems.darkroom.fixed_agent import LEFT, RIGHT, STAY, UP, Agent, Clock, game

NO_GOALS: tuple[Any, ...] = ([3, 0], [0, -1], [0], "00", [0, 1.0], [True, 0], {})
"""Values that are no goal of a 3x3 room."""


@pytest.fixture
def run(small_run):
    return small_run  # 3 x 3, 8 steps


def play(g, steps):
    for _ in range(steps):
        g.step()


def test_the_agent_observes_its_own_action_and_the_outcome_only(run):
    g = game(run)
    g.command({"do": "goal", "value": [1, 0]})
    g.command({"do": "push", "value": RIGHT})
    play(g, 2)
    (before, action, reward, after, done), (_, _, second, end, _) = g.agent.observed
    assert (before.tolist(), action, reward, after.tolist(), done) == ([0, 0], UP, 1, [1, 0], False)
    assert (second, end.tolist()) == (0, [1, 1])
    assert g.path == [(3, "person"), (4, "agent")] and g.total == 1


def test_every_step_is_a_move_and_walls_stop_it(run):
    g = game(run)
    g.command({"do": "p", "value": 0.7})
    at = np.zeros(2)
    play(g, 7)
    for cell, _ in g.path:
        moved = [np.clip(at + move, 0, 2).tolist() for move in MOVES]
        at = cells(3)[cell]
        assert at.tolist() in moved


def test_the_adversary_overrides_with_its_probability_and_its_action_distribution(run):
    g = game(run)
    g.command({"do": "p", "value": 0.4})
    g.command({"do": "distribution", "value": RIGHT})
    play(g, 8 * 200)
    share = sum(e.overridden for e in g.episodes) / (8 * len(g.episodes))
    assert abs(share - 0.4) < 0.05 and not any(e.by_hand for e in g.episodes)
    g.command({"do": "p", "value": 1})
    play(g, 8)
    assert [cell for cell, _ in g.path] == [3] + [6] * 7 and {cause for _, cause in g.path} == {"random"}


def test_a_held_action_continues_until_it_is_released_or_expires(run):
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
    assert [cause for _, cause in g.path] == ["person"] * 3 + ["agent", "person", "agent"]


def test_a_short_tap_between_two_steps_is_not_lost(run):
    g = game(run)
    g.command({"do": "hold", "value": RIGHT})
    g.command({"do": "hold", "value": None})
    play(g, 2)
    assert [cause for _, cause in g.path] == ["person", "agent"]


def test_the_optimum_is_the_expected_return_of_the_oracle_for_this_goal_and_adversary(run):
    g = game(run)
    for p, action, q in ((0.0, None, [0.2] * 5), (0.5, None, [0.2] * 5), (0.5, LEFT, [0, 1, 0, 0, 0])):
        g.command({"do": "p", "value": p})
        g.command({"do": "distribution", "value": action})
        h = Hypotheses(3, 8, np.array([7]), np.array([p]), np.array([q], np.float64))
        assert g.optimum == pytest.approx(optimal_returns(h)[0])
    assert g.snapshot()["distribution"] == LEFT


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
def test_a_moved_goal_resets_the_context_unless_it_is_kept(run, keep):
    g = game(run, Agent(STAY))
    g.command({"do": "keep", "value": keep})
    resets = g.agent.resets
    play(g, 5)
    g.command({"do": "goal", "value": [0, 0]})
    assert g.agent.resets == resets + (not keep)
    play(g, 2)
    read = g.belief()
    assert read.transitions == (7 if keep else 2)
    assert read.exact[0] == pytest.approx(1), "earlier transitions, which exclude the new goal, are not used"
    g.command({"do": "goal", "value": [0, 1]})
    assert g.belief().exact == pytest.approx(np.full(9, 1 / 9))


@pytest.mark.parametrize("deploy", ["paper", "committed"])
def test_the_exact_posterior_conditions_on_the_context_of_the_agent(run, deploy):
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


def test_snapshots_and_histories_are_json_of_bounded_size(run):
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
    ("fields", "message"),
    [
        ({}, "do='None': expected one of goal, p, distribution"),
        ({"do": "reset"}, "do='reset'"),
        ({"do": ["p"]}, "do="),
        ({"do": "p"}, "p: expected the fields do, value"),
        ({"do": "step", "value": 1}, "step: expected the fields do"),
        ({"do": "p", "value": 0.5, "more": 1}, "p: expected the fields"),
        *(({"do": "p", "value": v}, "a number from 0 to 1") for v in (-0.1, 1.1, "0.5", True, None, [0.5], 10**400)),
        *(({"do": "goal", "value": v}, "expected [x, y], each 0 to 2") for v in NO_GOALS),
        *(({"do": "push", "value": v}, "expected 0 to 4") for v in (-1, 5, 1.0, True, None, "up")),
        *(({"do": "hold", "value": v}, "expected 0 to 4") for v in (-1, 5, False)),
        *(({"do": "distribution", "value": v}, "expected 0 to 4") for v in (7, "uniform")),
        *(({"do": "speed", "value": v}, "a number from 0.5 to 100") for v in (0, 1000, None)),
        *(({"do": "pause", "value": v}, "expected true or false") for v in (0, 1, "true", None)),
        ({"do": "x" * 5000}, "do='xxxx"),
    ],
)
def test_an_invalid_command_is_refused_in_a_short_line_and_changes_nothing(run, fields, message):
    g = game(run)
    before = g.snapshot()
    with pytest.raises(ValueError) as error:
        g.command(fields)
    assert message in str(error.value) and len(str(error.value).splitlines()) == 1 and len(str(error.value)) < 200
    assert g.snapshot() == before
