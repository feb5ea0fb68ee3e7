"""Averages of a phase: the same variations in every episode, and the same numbers whatever the order of arrival."""

import pytest

from icrl_dist.monitor import variations
from icrl_dist.monitor.averages import of_phase
from icrl_dist.monitor.run_state import RunState
from tests.monitor.messages import DIRICHLET, progress, send, send_trajectories, trajectory

UNSOLVED = {"adversary": DIRICHLET.replace(alpha=(0.0,) * 5)}


def test_a_variation_that_is_behind_or_has_a_gap_is_not_in_the_mean():
    whole, good = dict.fromkeys(range(10), 1.0), dict.fromkeys(range(10), 3.0)
    behind, gap = dict.fromkeys(range(4), 9.0), {t: 9.0 for t in range(10) if t != 7}
    found = of_phase([(one, None) for one in (whole, good, behind, gap)], 256)
    assert (found["variations"], found["of"], found["trials"]) == (2, 4, 10)
    assert (found["first"], found["last"], found["scaled"]) == (2.0, 2.0, False), "9.0 would be a peak that never was"


def test_the_mean_of_an_unfinished_phase_is_over_as_many_returns_as_possible():
    ahead, behind = dict.fromkeys(range(12), 9.0), dict.fromkeys(range(6), 1.0)
    found = of_phase([(ahead, None), *[(behind, None)] * 3], 256)
    assert (found["variations"], found["trials"], found["last"]) == (4, 6, 3.0)
    found = of_phase([(ahead, None), *[(dict.fromkeys(range(2), 1.0), None)] * 3], 256)
    assert (found["variations"], found["trials"], found["last"]) == (1, 12, 9.0)
    assert of_phase([({1: 1.0}, None)], 256)["last"] is None, "the first episode is missing"


def test_with_an_optimum_only_variations_that_have_one_are_in_the_mean():
    found = of_phase([({0: 2.0}, 4.0), ({0: 9.0}, None), ({0: 9.0}, 0.0)], 256)
    assert (found["variations"], found["of"], found["last"], found["scaled"]) == (1, 3, 0.5, True)


def test_only_the_newest_returns_of_a_long_phase_count():
    long = {t: float(t) for t in range(92, 100)}
    found = of_phase([(long, None), (dict.fromkeys(range(90, 98), 0.0), None)], 8)
    assert (found["variations"], found["trials"]) == (2, 98), "trials 92 to 97, which both have"
    assert (found["first"], found["last"]) == (46.0, 47.5)
    far = of_phase([(long, None), (dict.fromkeys(range(4), 0.0), None)], 8)
    assert (far["variations"], far["first"], far["last"]) == (1, 92.0, 97.0), "they have no trial in common"


@pytest.mark.parametrize("order", [1, -1])
def test_averages_and_lineage_do_not_depend_on_the_order_of_arrival(order):
    state = RunState("demo")
    every = [(n, v, t) for n in range(5) for v in range(3) for t in range(20)]
    for number, variation, trial in every[::order]:
        total = (number + variation + trial) % 5
        send_trajectories(state, trajectory(f"adapt/{number}/0/{variation}/{trial}", total=total, **UNSOLVED))
    for now in range(9):  # four optima a tick
        state.tick(float(now))
    shown = state.snapshot(1.0)
    assert [(one["name"], one["variations"], one["of"]) for one in shown["averages"]] == [
        (f"adapt/{n}", 3, 3) for n in (2, 3, 4)
    ]
    expected = [sum((n + v + t) % 5 for v in range(3) for t in range(15, 20)) / 15 for n in (2, 3, 4)]
    assert [one["last"] for one in shown["averages"]] == pytest.approx(expected)
    detail = state.variation("0/1")
    assert detail is not None
    assert [one["identity"] for one in detail["lineage"]][-1] == "adapt/4/0/1/19" and len(detail["lineage"]) == 32


def test_averages_of_many_variations_are_computed_at_some_ticks_only(monkeypatch):
    monkeypatch.setattr(variations, "_PROMPT", 1)
    state = RunState("demo")
    send_trajectories(state, *(trajectory(f"adapt/0/{task}/0/0", **UNSOLVED) for task in range(3)))
    seen = []
    for now in range(9):
        state.tick(float(now))
        seen.append(len(state.snapshot(float(now))["averages"]))
    assert seen[0] == 0 and seen[-1] == 1


def test_rounds_that_have_not_begun_do_not_displace_those_that_have():
    state = RunState("demo")
    send(state, "learner", progress(phase="adapt", round=1))
    for number in (7, 8, 9):  # wrong messages
        send_trajectories(state, *(trajectory(f"adapt/{number}/0/0/{t}", **UNSOLVED) for t in range(20)))
    for number in (0, 1):
        send_trajectories(state, *(trajectory(f"adapt/{number}/0/0/{t}", **UNSOLVED) for t in range(20)))
    detail = state.variation("0/0")
    assert detail is not None
    assert [phase["name"] for phase in detail["phases"]] == ["adapt/0", "adapt/1", "adapt/9"]
    assert {one["identity"].rpartition("/")[0] for one in detail["lineage"]} == {"adapt/0/0/0", "adapt/1/0/0"}
    send_trajectories(state, trajectory("pretrain/0/0/0/0", **UNSOLVED))
    detail = state.variation("0/0")
    assert detail is not None and [phase["name"] for phase in detail["phases"]] == ["pretrain/0", "adapt/0", "adapt/1"]


def test_the_average_of_a_finished_round_does_not_change_when_a_later_round_begins():
    state = RunState("demo")
    for number in range(3):
        send_trajectories(
            state, *(trajectory(f"adapt/{number}/{v}/0/{t}", total=v, **UNSOLVED) for v in range(4) for t in range(6))
        )
    for now in range(9):  # four optima a tick
        state.tick(float(now))
    before = {one["name"]: one for one in state.snapshot(0.0)["averages"]}
    send_trajectories(state, trajectory("adapt/3/0/0/0", **UNSOLVED))
    after = {one["name"]: one for one in state.snapshot(0.0)["averages"]}
    assert [*after] == ["adapt/1", "adapt/2", "adapt/3"], "of adapt/0 one variation has no returns any more"
    assert all(after[name] == before[name] and before[name]["last"] is not None for name in ("adapt/1", "adapt/2"))


def test_a_finished_round_has_no_mean_until_every_optimum_is_computed():
    state = RunState("demo")
    send_trajectories(state, *(trajectory(f"adapt/0/{task}/0/{t}", total=task) for task in range(6) for t in range(3)))
    shown = []
    for now in range(3):
        (one,) = state.snapshot(float(now))["averages"]
        shown.append((one["pending"], one["variations"], one["last"]))
        state.tick(float(now))
    assert shown[:2] == [(6, 0, None), (2, 0, None)] and shown[2][:2] == (0, 6)
    send(state, "learner", progress())
    send_trajectories(state, trajectory("adapt/0/7/0/0"))
    assert state.snapshot(3.0)["averages"][0]["variations"] == 6, "a round that is being collected is shown as it is"


def test_returns_that_arrive_before_the_learner_names_their_round_are_kept():
    state = RunState("demo")
    for number in range(3):
        send(state, "learner", progress(phase="adapt", round=number))
        send_trajectories(state, trajectory(f"adapt/{number}/0/0/0", **UNSOLVED))
    send_trajectories(state, trajectory("adapt/3/0/0/0", **UNSOLVED))
    send(state, "learner", progress(phase="adapt", round=3))
    send_trajectories(state, trajectory("adapt/3/0/0/1", **UNSOLVED))
    detail = state.variation("0/0")
    assert detail is not None and detail["phases"][-1]["trials"] == [0, 1]
