"""Variations of a run state: returns, optima, quarantines, lineage, and the changes in a snapshot."""

import json

import numpy as np
import pytest

from icrl_dist.monitor import variations
from icrl_dist.monitor.run_state import RunState
from icrl_dist.monitor.view_state import by_episode
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns
from tests.monitor.messages import DIRICHLET, ROOM, event, send, send_trajectories, trajectory
from tests.optional import known


def test_a_variation_row_has_adversary_returns_by_trial_and_exact_optimum():
    state = RunState("demo")
    send_trajectories(state, *(trajectory(f"adapt/1/3/1/{trial}", total=trial) for trial in (0, 2, 1)))
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    assert (row["name"], row["problem"]) == ("3/1", "darkroom")
    assert row["parameters"] == {"goal": [2, 1], "size": 4, "horizon": 9, "start": [0, 0]}
    assert row["adversary"] == {"kind": "dirichlet", "p": 0.2, "alpha": [1.0] * 5}
    (phase,) = row["phases"]
    assert (phase["name"], phase["trials"], phase["returns"]) == ("adapt/1", [0, 1, 2], [0.0, 1.0, 2.0])
    assert row["optimum"] == pytest.approx(optimal_returns(Hypotheses.of([trajectory().variation]))[0])


def test_every_round_has_its_own_adversary_and_optimum_and_phases_are_in_order():
    state = RunState("demo")
    rounds = {f"adapt/{n}": DIRICHLET.replace(p=p) for n, p in ((1, 0.6), (0, 0.1))}  # an earlier round may arrive later
    for name, adversary in rounds.items():
        send_trajectories(state, trajectory(f"{name}/3/1/0", adversary=adversary))
    row = known(state.variation("3/1"))
    assert (row["optimum"], [phase["optimum"] for phase in row["phases"]]) == (None, [None, None]), "not computed yet"
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    best = {name: optimal_returns(Hypotheses.of([trajectory(adversary=one).variation]))[0] for name, one in rounds.items()}
    assert [phase["name"] for phase in row["phases"]] == ["adapt/0", "adapt/1"]
    for phase in row["phases"]:
        assert phase["optimum"] == pytest.approx(best[phase["name"]]) and best["adapt/0"] > best["adapt/1"] + 1
        assert phase["adversary"]["p"] == dict(rounds[phase["name"]].params)["p"]
    assert (row["optimum"], row["adversary"]["p"]) == (pytest.approx(best["adapt/1"]), 0.6)
    send_trajectories(state, trajectory("adapt/2/3/1/0", adversary=DIRICHLET))
    row = known(state.variation("3/1"))
    assert (row["optimum"], row["adversary"]["p"]) == (None, 0.2), "not the optimum of the round before"


def test_a_quarantine_belongs_to_its_phase_and_needs_no_episode():
    state = RunState("demo")
    send(state, "event", event("quarantine", "it crashes", identity="adapt/0/3/1"))
    send_trajectories(state, trajectory("adapt/1/4/0/0"))
    send(state, "event", event("quarantine", "stuck", identity="adapt/1/4/0"))
    send(state, "event", event("quarantine", "long ago", identity="adapt/0/5/0"))
    send_trajectories(state, trajectory("adapt/1/5/0/0"))
    state.tick(1.0)
    rows = {row["name"]: row for row in state.snapshot(1.0)["variations"]}
    assert {name: row["quarantine"] for name, row in rows.items()} == {"3/1": "it crashes", "4/0": "stuck", "5/0": ""}
    assert rows["3/1"]["phases"][0]["returns"] == [] and rows["3/1"]["adversary"] == {}
    send_trajectories(state, trajectory("adapt/0/3/1/0"))
    row = known(state.variation("3/1"))
    assert row["adversary"]["kind"] == "dirichlet" and row["quarantine"]
    for name in ("3/1", "4/0"):
        send_trajectories(state, trajectory(f"adapt/2/{name}/0"))
        assert known(state.variation(name))["quarantine"] == "", "a new round has another adversary"


def test_with_random_starts_the_optimum_is_the_mean_over_cells():
    state = RunState("demo")
    random_start = ROOM.replace(start="random")
    send_trajectories(state, trajectory(task=random_start))
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    hypotheses = Hypotheses.of([trajectory(task=random_start).variation])
    every = [optimal_returns(hypotheses, (x, y))[0] for x in range(4) for y in range(4)]
    assert row["optimum"] == pytest.approx(np.mean(every))


def test_the_detail_of_a_variation_has_its_lineage_and_newest_episode():
    state = RunState("demo")
    send_trajectories(state, trajectory("adapt/0/3/1/0"), trajectory("adapt/0/3/1/1", total=3.0, worker="w1"), now=5.0)
    found = known(state.variation("3/1"))
    assert [line["identity"] for line in found["lineage"]] == ["adapt/0/3/1/0", "adapt/0/3/1/1"]
    expected = {"episode_return": 3.0, "policy_version": 0, "weights_digest": "d" * 64, "worker": "w1", "time": 5.0}
    assert found["lineage"][-1] == {"identity": "adapt/0/3/1/1", **expected}
    drawing = found["episode"]["drawing"]
    assert drawing["path"] == [[min(step, 3), 0] for step in range(10)]
    assert drawing["overridden"] == [step == 2 for step in range(9)]
    assert (drawing["kind"], drawing["size"], drawing["goal"]) == ("room", 4, [2, 1])
    for unknown in ("3/2", "3", "a/b", "", "1/1/1", "-1/1", "9" * 30 + "/1"):
        assert state.variation(unknown) is None


def test_a_later_snapshot_has_only_what_changed():
    state = RunState("demo")
    send_trajectories(state, trajectory("adapt/0/3/1/0"), trajectory("adapt/0/4/0/0"))
    send(state, "event", event("note", "one"))
    state.tick(1.0)
    first = state.snapshot(1.0)
    send_trajectories(state, trajectory("adapt/0/4/0/1"))
    send(state, "event", event("note", "two"))
    state.tick(2.5)
    second = state.snapshot(2.5, first["seq"])
    assert [row["name"] for row in first["variations"]] == ["3/1", "4/0"]
    assert [row["name"] for row in second["variations"]] == ["4/0"]
    assert [one["name"] for one in second["episodes"]] == ["4/0"]
    assert [one["text"] for one in second["events"]] == ["two"]
    assert len(second["series"]["t"]) == 1
    state.tick(2.6)
    third = state.snapshot(2.6, second["seq"])
    assert not (third["variations"] or third["episodes"] or third["events"] or third["series"]["t"])


def test_every_change_reaches_a_snapshot_when_there_are_many(monkeypatch):
    monkeypatch.setattr(variations, "_CHANGES_PER_TICK", 3)
    state, names, since = RunState("demo"), [], -1
    state.tick(0.0)
    since = state.snapshot(0.0)["seq"]
    send_trajectories(state, *(trajectory(f"adapt/0/{task}/0/0") for task in range(8)))
    for now in range(1, 6):
        state.tick(float(now))
        shown = state.snapshot(float(now), since)
        since = shown["seq"]
        names += [row["name"] for row in shown["variations"]]
    assert {*names} == {f"{task}/0" for task in range(8)}


@pytest.mark.parametrize("alpha", [1e5, 1e308, 0.0])
def test_the_optimum_is_unknown_where_the_adversary_gives_no_finite_numbers(alpha):
    state = RunState("demo")
    send_trajectories(state, trajectory(adversary=DIRICHLET.replace(alpha=(alpha,) * 5)))
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    assert row["optimum"] is None and json.dumps(row, allow_nan=False)


def test_missing_episodes_are_one_gap_in_a_text_drawing_however_many_they_are():
    assert by_episode([0, 1, 5, 6, 2**40], [1.0, 2.0, 3.0, 4.0, 5.0]) == [1.0, 2.0, None, 3.0, 4.0, None, 5.0]
    assert by_episode([], []) == []
