"""The state of a run: what it shows, what it bounds, what it leaves out."""

import contextlib
import json

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.monitor import variations, workers
from icrl_dist.monitor.rates import RateSeries
from icrl_dist.monitor.run_state import RunState
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns
from icrl_dist.stream import monitor_messages, wire
from tests.monitor.messages import DIRICHLET, ROOM, event, heartbeat, progress, run_info, send, send_trajectories, trajectory


def test_a_variation_is_its_adversary_its_returns_by_trial_and_its_exact_optimum():
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


def test_every_round_has_its_own_adversary_and_optimum_and_the_newest_phase_is_the_last():
    state = RunState("demo")
    rounds = {f"adapt/{n}": DIRICHLET.replace(p=p) for n, p in ((1, 0.6), (0, 0.1))}  # what is late comes in its place
    for name, adversary in rounds.items():
        send_trajectories(state, trajectory(f"{name}/3/1/0", adversary=adversary))
    row = state.variation("3/1")
    assert (row["optimum"], [phase["optimum"] for phase in row["phases"]]) == (None, [None, None]), "nobody knows it yet"
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    best = {name: optimal_returns(Hypotheses.of([trajectory(adversary=one).variation]))[0] for name, one in rounds.items()}
    assert [phase["name"] for phase in row["phases"]] == ["adapt/0", "adapt/1"]
    for phase in row["phases"]:
        assert phase["optimum"] == pytest.approx(best[phase["name"]]) and best["adapt/0"] > best["adapt/1"] + 1
        assert phase["adversary"]["p"] == dict(rounds[phase["name"]].params)["p"]
    assert (row["optimum"], row["adversary"]["p"]) == (pytest.approx(best["adapt/1"]), 0.6)
    send_trajectories(state, trajectory("adapt/2/3/1/0", adversary=DIRICHLET))
    row = state.variation("3/1")
    assert (row["optimum"], row["adversary"]["p"]) == (None, 0.2), "not that of the round before"


def test_a_quarantine_is_of_its_phase_and_known_though_nothing_was_earned_in_it():
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
    assert state.variation("3/1")["adversary"]["kind"] == "dirichlet" and state.variation("3/1")["quarantine"]
    for name in ("3/1", "4/0"):
        send_trajectories(state, trajectory(f"adapt/2/{name}/0"))
        assert state.variation(name)["quarantine"] == "", "it is another variation now"


def test_from_random_starts_the_optimum_is_the_mean_over_the_cells():
    state = RunState("demo")
    random_start = ROOM.replace(start="random")
    send_trajectories(state, trajectory(task=random_start))
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    hypotheses = Hypotheses.of([trajectory(task=random_start).variation])
    every = [optimal_returns(hypotheses, (x, y))[0] for x in range(4) for y in range(4)]
    assert row["optimum"] == pytest.approx(np.mean(every))


def test_a_variation_tells_where_it_came_from_and_shows_its_newest_episode():
    state = RunState("demo")
    send_trajectories(state, trajectory("adapt/0/3/1/0"), trajectory("adapt/0/3/1/1", total=3.0, worker="w1"), now=5.0)
    found = state.variation("3/1")
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


def test_every_change_is_told_of_however_many_there_are(monkeypatch):
    monkeypatch.setattr(variations, "_CHANGES_PER_TICK", 3)
    state, told, since = RunState("demo"), [], -1
    state.tick(0.0)
    since = state.snapshot(0.0)["seq"]
    send_trajectories(state, *(trajectory(f"adapt/0/{task}/0/0") for task in range(8)))
    for now in range(1, 6):
        state.tick(float(now))
        shown = state.snapshot(float(now), since)
        since = shown["seq"]
        told += [row["name"] for row in shown["variations"]]
    assert {*told} == {f"{task}/0" for task in range(8)}


def test_workers_work_wait_fall_silent_go_and_come_again():
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


def test_a_recording_that_stands_still_grows_nothing_and_rates_go_on_from_there():
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


def test_the_next_life_of_a_worker_takes_its_row():
    state = RunState("demo")
    send(state, "worker/w0", heartbeat("w0"), 0.0)
    send(state, "worker/w1", heartbeat("w1"), 0.0)
    for now, name in ((1.0, "w1"), (2.0, "w1-1")):
        send(state, "event", event("worker", f"worker {name} is gone", worker=name, alive=False), now)
        send(state, "worker/w1", heartbeat(f"w1-{int(now)}", pid=8), now)
    send(state, "worker/host-1", heartbeat("host-1"), 2.0)  # two of a kind, both alive
    send(state, "worker/host-2", heartbeat("host-2"), 2.0)
    rows = {row["name"]: (row["state"], row["restarts"]) for row in state.snapshot(2.0)["workers"]}
    assert rows == {name: ("working", 2 if name == "w1-2" else 0) for name in ("host-1", "host-2", "w0", "w1-2")}


def test_a_workers_lag_is_that_of_the_weights_that_act_in_its_job():
    state = RunState("demo")
    send(state, "learner", progress(version=3))
    for worker, said in {
        "w0": {"policy_version": 1},
        "w1": {"policy_version": 3},
        "w2": {"policy_version": -1},
        "w3": {"policy_version": 1, "job": ""},
    }.items():
        send(state, f"worker/{worker}", heartbeat(worker, **said))
    assert [row["lag"] for row in state.snapshot(0.0)["workers"]] == [2, 0, 0, 0]


def test_the_run_goes_through_its_states():
    state = RunState("demo")
    assert state.snapshot(0.0)["run"]["state"] == "waiting"
    send(state, "run", run_info())
    send(state, "learner", progress(step=10, trajectories=10), 0.0)
    send(state, "learner", progress(step=30, trajectories=30, drops={"busy": 2}), 1.0)
    run = state.snapshot(1.0)["run"]
    assert (run["state"], run["elapsed_s"], run["stage_eta_s"], run["eta_s"]) == ("collecting", 6.0, pytest.approx(3.5), None)
    assert (run["method"], run["variations"], run["drops"]) == ("icaa", 14, {"busy": 2})
    assert state.snapshot(10.0)["run"]["state"] == "silent"
    send(state, "learner", progress(stage="fit", step=5, steps=30, loss=0.5), 11.0)
    run = state.snapshot(11.0)["run"]
    assert (run["state"], run["loss"]) == ("fitting", 0.5)
    send(state, "event", event("version", "T^1 is fitted", version=1), 12.0)
    send(state, "event", event("finished", "finished"), 12.0)
    run = state.snapshot(100.0)["run"]
    assert (run["state"], run["version"]) == ("finished", 1)


def test_the_time_left_is_that_of_the_stage_the_fit_and_the_phases_to_come():
    rates = RateSeries()
    rates.phases = [("pretrain", 0, 60), ("adapt", 0, 30), ("adapt", 1, 30)]

    def at(now, **where):
        run = {"stage": "collect", "phase": "adapt", "round": 0, "steps": 100, "trajectories": 0} | where
        rates.update(run, now)
        return rates.eta_s(run)

    assert at(0.0, phase="pretrain", step=0) is None
    assert at(1.0, phase="pretrain", step=50) is None, "no fit was seen"
    assert at(10.0, stage="fit", phase="pretrain", step=0, steps=60) is None
    assert at(12.0, stage="fit", phase="pretrain", step=20, steps=60) is None, "no round was seen"
    at(20.0, step=0)
    # 10 a second: 5 s to collect, 3 s to fit at 10 steps a second; 10 s and 3 s for the last round
    assert at(25.0, step=50) == pytest.approx(5 + 3 + 10 + 3)


def test_rates_are_counted_once_a_second():
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


def test_alerts_are_shown_while_they_are_on_and_a_quarantine_in_its_phase():
    state = RunState("demo")
    send_trajectories(state, trajectory("adapt/0/3/1/0"))
    send(state, "event", event("alert", "stuck at zero", alert="zero", active=True))
    send(state, "event", event("quarantine", "it crashes", identity="adapt/0/3/1"))
    shown = state.snapshot(1.0)
    assert shown["alerts"] == [{"name": "zero", "text": "stuck at zero", "since": 1.0}]
    assert shown["variations"][0]["quarantine"] == "it crashes"
    send(state, "event", event("alert", "over: stuck at zero", alert="zero", active=False))
    assert state.snapshot(1.0)["alerts"] == []
    for name in ("adapt/0/3", "adapt/0/3/-1", "3/1", "nowhere/0/3/1"):
        send(state, "event", event("quarantine", "what?", identity=name))
    assert state.ignored["schema"] == 4 and state.snapshot(1.0)["variations"][0]["quarantine"] == "it crashes"
    send(state, "event", event("released", "it is tried again", identity="adapt/0/3/1"))
    assert state.snapshot(1.0)["variations"][0]["quarantine"] == ""


def test_the_alerts_that_are_on_are_those_the_learner_repeats():
    on = [{"name": "zero", "text": "stuck", "since": 2.0}, {"name": "silent w0", "text": "w0 is silent", "since": 3.0}]
    late = RunState("demo")
    send(late, "run", run_info(alerts=on))
    assert late.snapshot(9.0)["alerts"] == on, "the events were before its time"
    send(late, "event", event("alert", "stuck in more", alert="zero", active=True, time=8.0))
    assert late.snapshot(9.0)["alerts"][0] == {"name": "zero", "text": "stuck in more", "since": 2.0}
    send(late, "run", run_info(alerts=on[1:]))  # that it is over was dropped, or the learner began anew
    send(late, "run", run_info())  # a recording does not say
    for odd in ([1], [{"name": "x", "text": "x"}], "x", [{"name": "x", "text": "x", "since": 1e300}]):
        send(late, "run", run_info(alerts=odd))
    send(late, "run", run_info(alerts=on * 2000))
    assert late.snapshot(9.0)["ignored"] == {"schema": 4} and len(late.snapshot(9.0)["alerts"]) == 2
    send(late, "run", run_info(alerts=[]))
    assert late.snapshot(9.0)["alerts"] == []


def test_memory_is_bounded_whatever_comes(monkeypatch):
    monkeypatch.setattr(variations, "MAX_VARIATIONS", 5)
    monkeypatch.setattr(variations, "_MAX_RETURNS", 12)
    monkeypatch.setattr(variations, "_OPTIMA_PER_TICK", 0)
    monkeypatch.setattr(workers, "_MAX_WORKERS", 3)
    state = RunState("demo")
    for n in range(300):
        send_trajectories(state, trajectory(f"adapt/0/{n % 9}/0/{n}"))
        send(state, f"worker/w{n}", heartbeat(f"w{n}"))
        send(state, "event", event("note", f"{n}"))
    for n in range(20):
        send_trajectories(state, *(trajectory(f"adapt/{n}/0/0/{m}") for m in range(15)))
    assert len(state._variations._unsolved) == 5 * 3
    state.tick(1.0)
    shown = state.snapshot(1.0)
    assert (len(shown["variations"]), shown["variation_count"], shown["variations_left_out"]) == (5, 9, 4)
    assert len(shown["workers"]) == 3 and len(shown["events"]) == 200 and len(shown["episodes"]) <= 48
    phases = shown["variations"][0]["phases"]
    assert [phase["name"] for phase in phases] == ["adapt/17", "adapt/18", "adapt/19"]
    assert all(len(phase["returns"]) == 12 and phase["trials"][-1] == 14 for phase in phases)
    assert shown["ignored"] == {"too many variations": 132, "too many workers": 297}


def test_one_run_is_shown_and_another_at_the_same_place_left_out():
    state = RunState()
    for kind, message in (("event", event("note", "x")), ("x", wire.encode_message("x")), ("learner", progress(phase=None))):
        send(state, kind, message, run="stray")
    assert state.snapshot(0.0)["run"]["name"] == "", "only a learner's word says which run is on"
    send(state, "learner", progress())
    send(state, "learner", progress(version=9), 14.0, run="other")
    send(state, "event", event("finished", "x"), 14.0, run="other")
    shown = state.snapshot(0.0)
    assert (shown["run"]["name"], shown["run"]["version"], shown["run"]["state"]) == ("demo", 0, "collecting")
    assert shown["ignored"] == {"no run yet": 2, "schema": 1, "another run": 2}


@pytest.mark.parametrize("over", [True, False])
def test_the_next_run_at_the_same_place_is_shown_once_this_one_is_over_or_long_silent(over):
    state, named = RunState(), RunState("demo")
    for one in (state, named):
        send(one, "learner", progress(version=4))
        send_trajectories(one, trajectory())
        if over:
            send(one, "event", event("finished", "x"), 1.0)
        send(one, "learner", progress(), 2.0 if over else 20.0, run="next")
        send(one, "event", event("note", "of the next"), 20.0, run="next")
    shown = state.snapshot(20.0)
    assert (shown["run"]["name"], shown["run"]["version"], shown["variations"], shown["ignored"]) == ("next", 0, [], {})
    assert [one["text"] for one in shown["events"]] == ["of the next"] and shown["epoch"] != named.snapshot(20.0)["epoch"]
    assert named.snapshot(20.0)["run"]["name"] == "demo", "it was asked for"


@pytest.mark.parametrize("how", ["finished", "interrupted", "failed"])
def test_a_run_that_was_over_may_go_on(how):
    state = RunState()
    send(state, "learner", progress(), 0.0)
    send(state, "event", event(how, "x", time=5.0), 5.0)
    send(state, "learner", progress(time=4.9), 5.1)
    run = state.snapshot(6.0)["run"]
    assert (run["state"], run["ended"]) == (how, 5.0), "that was said before"
    send(state, "learner", progress(time=9.0), 9.0)
    run = state.snapshot(9.0)["run"]
    assert run["state"] == "collecting" and "ended" not in run


MESSAGES = {
    "trajectories": monitor_messages.trajectories([trajectory()], 0.0),
    "episode": monitor_messages.episode(trajectory(), 0.0),
    "worker": heartbeat(),
    "learner": progress(),
    "run": run_info(),
    "event": event("worker", "joined", worker="w0", alive=True),
}
ODD = [
    None,
    -1,
    2**70,
    1.5,
    float("nan"),
    float("inf"),
    "",
    "x" * 5000,
    "\x1b[31m\n",
    b"\xff",
    [],
    [[]],
    {},
    {"a": {"b": 1}},
    True,
]


@pytest.mark.parametrize("kind", MESSAGES)
def test_no_field_of_any_message_can_break_it(kind):
    state = RunState("demo")
    whole = msgpack.unpackb(MESSAGES[kind])
    for name in whole:
        send(state, "x", msgpack.packb({k: v for k, v in whole.items() if k != name}))
        for odd in ODD:
            try:
                message = msgpack.packb(whole | {name: odd})
            except OverflowError:
                continue
            send(state, "x", message)
    for name in wire.decode_message(MESSAGES["trajectories"])[1]["variations"][0] if kind == "trajectories" else ():
        for odd in ODD:
            broken = dict(whole["variations"][0]) | {name: odd}
            with contextlib.suppress(OverflowError):
                send(state, "x", msgpack.packb(whole | {"variations": [broken]}))
    state.tick(1.0)
    text = json.dumps(state.snapshot(1.0), allow_nan=False)
    assert "\\u001b" not in text and sum(state.ignored.values()) > len(ODD)
    assert state.received > sum(state.ignored.values()), "some were taken in"


IMPOSSIBLE = [
    ("learner", progress, {"phase": None}),
    ("learner", progress, {"phase": "x"}),
    ("learner", progress, {"stage": "finished"}),
    ("learner", progress, {"doing": [1]}),
    ("run", run_info, {"began": -1.7e308}),
    ("run", run_info, {"began": 3e11}),
    ("run", run_info, {"phases": [["pretrain", 0, -1]]}),
    ("event", lambda **odd: event("finished", "x", **odd), {"time": 1.7e308}),
    ("event", lambda **odd: event("finished", "x", **odd), {"time": -3e11}),
    ("event", lambda **odd: event("version", "x", **odd), {"version": -1}),
    ("event", lambda **odd: event("quarantine", "x", **odd), {"identity": "3/1"}),
]


@pytest.mark.parametrize(("kind", "message", "odd"), IMPOSSIBLE)
def test_of_a_message_with_one_odd_field_nothing_is_believed(kind, message, odd):
    state = RunState("demo")
    send(state, "learner", progress())
    before = state.snapshot(2.0)
    send(state, kind, message(**odd), 1.0)
    after = state.snapshot(2.0)
    assert after.pop("ignored") == {"schema": 1} and after.pop("heard") == before.pop("heard") + 1
    assert after == {name: value for name, value in before.items() if name != "ignored"}


@pytest.mark.parametrize("alpha", [1e5, 1e308, 0.0])
def test_where_a_law_makes_no_numbers_nobody_knows_the_optimum(alpha):
    state = RunState("demo")
    send_trajectories(state, trajectory(adversary=DIRICHLET.replace(alpha=(alpha,) * 5)))
    state.tick(1.0)
    (row,) = state.snapshot(1.0)["variations"]
    assert row["optimum"] is None and json.dumps(row, allow_nan=False)


@settings(max_examples=30, deadline=None)
@given(st.binary(max_size=200), st.text(max_size=20))
def test_no_bytes_can_break_it(payload, topic):
    state = RunState("demo")
    state.receive(f"icrl/{topic}/mon/x", payload, 0.0)
    state.receive(topic, payload, 0.0)
    state.tick(1.0)
    assert sum(state.ignored.values()) == state.received == 2


def test_a_huge_message_is_left_out():
    state = RunState("demo")
    send(state, "event", event("note", "x" * (2 << 20)))
    assert state.snapshot(0.0)["ignored"] == {"oversized": 1}


def test_a_belief_is_kept_a_worker():
    state = RunState("demo")
    law = [1 / 16] * 16
    said = {"identity": "adapt/0/3/1/7", "worker": "w0", "size": 4, "goal": [2, 1], "implied": law, "exact": law}
    send(state, "belief/w0", wire.encode_message("belief", time=0.0, **said))
    send(state, "belief/w0", wire.encode_message("belief", time=0.0, **said | {"implied": law[:-1]}))
    shown = state.snapshot(0.0)
    assert shown["beliefs"]["w0"]["goal"] == [2, 1] and shown["beliefs"]["w0"]["exact"] == law
    assert shown["ignored"] == {"schema": 1}
    for number in range(1, 20):
        send(state, "belief", wire.encode_message("belief", time=0.0, **said | {"worker": f"w{number}"}), 30.0)
    state.tick(50.0)
    assert state.snapshot(50.0)["believers"] == [f"w{number}" for number in range(16)], "so many at once"
    send(state, "event", event("worker", "w1 is gone", worker="w1", alive=False), 61.0)
    send(state, "belief", wire.encode_message("belief", time=0.0, **said | {"worker": "w2"}), 61.0)
    state.tick(61.0)
    shown = state.snapshot(61.0, state.seq - 1)
    assert shown["believers"] == [f"w{number}" for number in range(2, 16)] and [*shown["beliefs"]] == ["w2"]
    state.tick(100.0)
    send(state, "belief", wire.encode_message("belief", time=0.0, **said | {"worker": "w17"}), 100.0)
    assert state.snapshot(100.0)["believers"] == ["w2", "w17"], "there is room again"
