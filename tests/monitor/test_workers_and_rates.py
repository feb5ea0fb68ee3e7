"""States of workers, rates, and estimates of the remaining time."""

from typing import Any

import pytest

from icrl_dist.monitor import workers
from icrl_dist.monitor.rates import RateSeries
from icrl_dist.monitor.run_state import RunState
from tests.monitor.messages import event, heartbeat, progress, send, send_trajectories, trajectory


def test_states_of_a_worker_from_working_to_gone_and_back():
    state = RunState("demo")
    send(state, "worker/w0", heartbeat(steps=0, episodes=4, trajectories=3), 0.0)
    send(state, "worker/w1", heartbeat("w1", job=""), 0.0)
    for second in range(1, 5):
        send(state, "worker/w0", heartbeat(steps=100 * second, episodes=4, trajectories=3), float(second))
        state.tick(float(second))
    busy, idle = state.snapshot(4.0)["workers"]
    assert (busy["state"], busy["unstored"], busy["steps_per_s"]) == ("working", 1, pytest.approx(100.0))
    assert (idle["state"], idle["silent_s"]) == ("silent", 4.0)
    assert workers.SILENT_S < 3.0
    send(state, "event", event("worker", "worker w0 is gone", worker="w0", alive=False), 4.5)
    gone = state.snapshot(4.5)["workers"][0]
    assert (gone["state"], gone["job"], gone["steps_per_s"]) == ("gone", "", 0.0)
    send(state, "worker/w0", heartbeat(pid=8), 5.0)
    assert state.snapshot(5.0)["workers"][0]["state"] == "working"
    assert state.snapshot(5.0)["workers"][0]["restarts"] == 1
    send(state, "event", event("finished", "finished with T^2"), 6.0)
    assert [row["state"] for row in state.snapshot(6.0)["workers"]] == ["done", "done"]


def test_a_paused_recording_keeps_memory_bounded_and_rates_correct():
    state = RunState("demo", recorded=True)
    for second in range(5):
        send(state, "worker/w0", heartbeat(steps=100 * second), float(second))
        state.tick(float(second))
    for _ in range(1000):
        state.tick(4.0)
    state.tick(3.5)  # a clock is set back
    (row,) = state._workers._workers.values()
    assert len(row.history) < 8
    assert state.snapshot(4.0)["workers"][0]["steps_per_s"] == pytest.approx(100.0, rel=0.3)


def test_a_restarted_worker_takes_the_row_of_its_predecessor():
    state = RunState("demo")
    send(state, "worker/w0", heartbeat("w0"), 0.0)
    send(state, "worker/w1", heartbeat("w1"), 0.0)
    for now, name in ((1.0, "w1"), (2.0, "w1-1")):
        send(state, "event", event("worker", f"worker {name} is gone", worker=name, alive=False), now)
        send(state, "worker/w1", heartbeat(f"w1-{int(now)}", pid=8), now)
    send(state, "worker/host-1", heartbeat("host-1"), 2.0)  # similar names, but both are alive
    send(state, "worker/host-2", heartbeat("host-2"), 2.0)
    rows = {row["name"]: (row["state"], row["restarts"]) for row in state.snapshot(2.0)["workers"]}
    assert rows == {name: ("working", 2 if name == "w1-2" else 0) for name in ("host-1", "host-2", "w0", "w1-2")}


def test_the_lag_of_a_worker_is_that_of_the_weights_in_its_job():
    state = RunState("demo")
    send(state, "learner", progress(version=3))
    jobs: dict[str, dict[str, Any]] = {
        "w0": {"policy_version": 1},
        "w1": {"policy_version": 3},
        "w2": {"policy_version": -1},
        "w3": {"policy_version": 1, "job": ""},
    }
    for worker, fields in jobs.items():
        send(state, f"worker/{worker}", heartbeat(worker, **fields))
    assert [row["lag"] for row in state.snapshot(0.0)["workers"]] == [2, 0, 0, 0]


def test_the_remaining_time_sums_stage_fit_and_later_phases():
    rates = RateSeries()
    rates.phases = [("pretrain", 0, 60), ("adapt", 0, 30), ("adapt", 1, 30)]

    def at(now, **where):
        run = {"stage": "collect", "phase": "adapt", "round": 0, "steps": 100, "trajectories": 0} | where
        rates.update(run, now)
        return rates.eta_s(run)

    assert at(0.0, phase="pretrain", step=0) is None
    assert at(1.0, phase="pretrain", step=50) is None, "the rate of fits is unknown"
    assert at(10.0, stage="fit", phase="pretrain", step=0, steps=60) is None
    assert at(12.0, stage="fit", phase="pretrain", step=20, steps=60) is None, "the rate of rounds is unknown"
    at(20.0, step=0)
    # At 10 a second: 5 s to collect and 3 s to fit in this round; 10 s and 3 s in the last round.
    assert at(25.0, step=50) == pytest.approx(5 + 3 + 10 + 3)


def test_rates_have_one_point_a_second():
    state = RunState("demo")
    send(state, "learner", progress(trajectories=10), 0.0)
    state.tick(0.0)
    send_trajectories(state, *(trajectory(f"adapt/0/0/0/{n}") for n in range(6)), now=1.0)
    send(state, "learner", progress(trajectories=14, lag=1), 1.0)
    for now in (0.5, 1.0, 1.5, 2.0):
        state.tick(now)
    series = state.snapshot(2.0)["series"]
    assert (series["t"], series["number"]) == ([1.0, 2.0], [1, 2])
    assert (series["stored_per_s"], series["episodes_per_s"]) == ([4.0, 0.0], [6.0, 0.0])
    assert (series["loss"], series["lag"]) == ([None, None], [1, 1])
