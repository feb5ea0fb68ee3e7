"""A run state: which run it shows, states of the run, alerts and beliefs."""

import pytest

from icrl_dist.monitor.run_state import RunState
from icrl_dist.stream import wire
from tests.monitor.messages import event, progress, run_info, send, send_trajectories, trajectory


def test_states_of_a_run():
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


def test_active_alerts_and_quarantines_are_shown():
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


def test_the_alerts_in_a_run_message_replace_the_known_ones():
    on = [{"name": "zero", "text": "stuck", "since": 2.0}, {"name": "silent w0", "text": "w0 is silent", "since": 3.0}]
    late = RunState("demo")
    send(late, "run", run_info(alerts=on))
    assert late.snapshot(9.0)["alerts"] == on, "the events were before this view started"
    send(late, "event", event("alert", "stuck in more", alert="zero", active=True, time=8.0))
    assert late.snapshot(9.0)["alerts"][0] == {"name": "zero", "text": "stuck in more", "since": 2.0}
    send(late, "run", run_info(alerts=on[1:]))  # the event about its end was lost, or the learner restarted
    send(late, "run", run_info())  # a recording has no alerts in this message
    for invalid in ([1], [{"name": "x", "text": "x"}], "x", [{"name": "x", "text": "x", "since": 1e300}]):
        send(late, "run", run_info(alerts=invalid))
    send(late, "run", run_info(alerts=on * 2000))
    assert late.snapshot(9.0)["ignored"] == {"schema": 4} and len(late.snapshot(9.0)["alerts"]) == 2
    send(late, "run", run_info(alerts=[]))
    assert late.snapshot(9.0)["alerts"] == []


def test_messages_of_another_run_at_the_same_endpoint_are_ignored():
    state = RunState()
    for kind, message in (("event", event("note", "x")), ("x", wire.encode_message("x")), ("learner", progress(phase=None))):
        send(state, kind, message, run="stray")
    assert state.snapshot(0.0)["run"]["name"] == "", "only learner and run messages select the run"
    send(state, "learner", progress())
    send(state, "learner", progress(version=9), 14.0, run="other")
    send(state, "event", event("finished", "x"), 14.0, run="other")
    shown = state.snapshot(0.0)
    assert (shown["run"]["name"], shown["run"]["version"], shown["run"]["state"]) == ("demo", 0, "collecting")
    assert shown["ignored"] == {"no run yet": 2, "schema": 1, "another run": 2}


@pytest.mark.parametrize("over", [True, False])
def test_the_next_run_at_the_endpoint_is_shown_once_this_run_is_over_or_silent_for_long(over):
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
    assert named.snapshot(20.0)["run"]["name"] == "demo", "a run that was selected by name stays"


@pytest.mark.parametrize("how", ["finished", "interrupted", "failed"])
def test_a_run_that_was_over_may_resume(how):
    state = RunState()
    send(state, "learner", progress(), 0.0)
    send(state, "event", event(how, "x", time=5.0), 5.0)
    send(state, "learner", progress(time=4.9), 5.1)
    run = state.snapshot(6.0)["run"]
    assert (run["state"], run["ended"]) == (how, 5.0), "the message is older than the event"
    send(state, "learner", progress(time=9.0), 9.0)
    run = state.snapshot(9.0)["run"]
    assert run["state"] == "collecting" and "ended" not in run


def test_one_belief_is_kept_for_each_worker_up_to_a_limit_and_an_age():
    state = RunState("demo")
    probs = [1 / 16] * 16
    fields = {"identity": "adapt/0/3/1/7", "worker": "w0", "size": 4, "goal": [2, 1], "implied": probs, "exact": probs}
    send(state, "belief/w0", wire.encode_message("belief", time=0.0, **fields))
    send(state, "belief/w0", wire.encode_message("belief", time=0.0, **fields | {"implied": probs[:-1]}))
    shown = state.snapshot(0.0)
    assert shown["beliefs"]["w0"]["goal"] == [2, 1] and shown["beliefs"]["w0"]["exact"] == probs
    assert shown["ignored"] == {"schema": 1}
    for number in range(1, 20):
        send(state, "belief", wire.encode_message("belief", time=0.0, **fields | {"worker": f"w{number}"}), 30.0)
    state.tick(50.0)
    assert state.snapshot(50.0)["believers"] == [f"w{number}" for number in range(16)], "the limit"
    send(state, "event", event("worker", "w1 is gone", worker="w1", alive=False), 61.0)
    send(state, "belief", wire.encode_message("belief", time=0.0, **fields | {"worker": "w2"}), 61.0)
    state.tick(61.0)
    shown = state.snapshot(61.0, state.seq - 1)
    assert shown["believers"] == [f"w{number}" for number in range(2, 16)] and [*shown["beliefs"]] == ["w2"]
    state.tick(100.0)
    send(state, "belief", wire.encode_message("belief", time=0.0, **fields | {"worker": "w17"}), 100.0)
    assert state.snapshot(100.0)["believers"] == ["w2", "w17"], "older beliefs are removed"
