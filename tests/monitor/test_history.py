"""Older points of a series: means in a bounded number of points that cover the whole run, with gaps kept."""

import pytest

from icrl_dist.monitor import history, past
from icrl_dist.monitor.catch_up import play
from icrl_dist.monitor.history import History
from icrl_dist.monitor.run_state import RunState
from tests.monitor import messages


def filled(seconds, value=lambda t: float(t), gaps=()):
    kept = History(("x", "y"))
    for t in range(seconds):
        kept.add(float(t), {"x": None, "y": None} if t in gaps else {"x": value(t), "y": None}, t)
    return kept.columns()


@pytest.mark.parametrize("seconds", [100, 10_000, 100_000])
def test_the_whole_run_is_covered_by_means_of_equal_length(seconds):
    found = filled(seconds, lambda t: float(t % 2))
    assert len(found["t"]) <= history._POINTS and len(found["t"]) >= min(seconds // 8, history._POINTS // 2) - 1
    steps = [late - early for early, late in zip(found["t"], found["t"][1:], strict=False)]
    assert max(steps) <= 2 * min(steps) and found["t"][0] <= max(steps) and seconds - found["t"][-1] <= 2 * max(steps)
    assert all(value == pytest.approx(0.5, abs=0.08) for value in found["x"])
    assert set(found["y"]) == {None}


def test_a_gap_stays_a_gap():
    found = filled(20_000, gaps=(5000,))
    assert found["x"].count(None) == 1 and found["t"][found["x"].index(None)] == 5000.0
    before, after = (found["x"][found["x"].index(None) + side] for side in (-1, 1))
    assert before < 5000 < after


def test_many_gaps_are_bounded_too():
    found = filled(20_000, gaps=range(0, 20_000, 3))
    assert len(found["t"]) <= history._POINTS and found["t"][-1] > 19_000


def test_a_snapshot_has_the_history_when_it_has_changed():
    state = RunState("demo")
    messages.send(state, "learner", messages.progress())
    for second in range(2000):
        state.tick(float(second))
    full = state.snapshot(2000.0)
    assert len(full["series"]["t"]) == 900 and full["history"]["t"][-1] < full["series"]["t"][0]
    assert full["history"]["t"][0] < 20 and full["series"]["t"][0] - full["history"]["t"][-1] < 20
    since = full["seq"]
    changed = 0
    for second in range(2000, 2032):
        state.tick(float(second))
        delta = state.snapshot(float(second), since)
        since, changed = delta["seq"], changed + (delta["history"] is not None)
    assert changed in (4, 5), "every eight seconds"


def test_a_view_that_joins_late_has_hours_without_gaps():
    """Progress before the last 15 minutes arrives at larger distances, which are no gaps; a pause is one."""
    hour = 3600
    rows = [{"time": t} for t in range(5 * hour) if not 2 * hour < t < 3 * hour]
    kept = [*past._thinned(rows[:-900], past._MAX_OLDER), *rows[-900:]]
    times = [float(row["time"]) for row in kept]
    sent = [(t, "icrl/demo/mon/learner", messages.progress(time=t, trajectories=int(10 * t))) for t in times]
    state = RunState("demo")
    play(state, sent, partial=True, apart_s=past.apart_s(times))
    shown = state.snapshot(times[-1])
    stored = shown["history"]["stored_per_s"] + shown["series"]["stored_per_s"]
    assert stored.count(None) == 1 and shown["history"]["t"][0] < 60
    assert [rate for rate in stored if rate is not None][1:] == pytest.approx([10.0] * (len(stored) - 2), rel=0.01)
