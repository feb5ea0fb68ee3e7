"""A run state ignores invalid messages and keeps its memory bounded."""

import contextlib
import json

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.monitor import variations, workers
from icrl_dist.monitor.run_state import RunState
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import WORKER_TOPICS
from tests.monitor.messages import event, heartbeat, progress, run_info, send, send_trajectories, trajectory


def test_memory_is_bounded_for_any_number_of_messages(monkeypatch):
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


MESSAGES = {
    "trajectories": monitor_messages.trajectories([trajectory()], 0.0),
    "episode": monitor_messages.episode(trajectory(), 0.0),
    "worker": heartbeat(),
    "learner": progress(),
    "run": run_info(),
    "event": event("worker", "joined", worker="w0", alive=True),
}


INVALID_VALUES: list[object] = [
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
def test_invalid_fields_of_any_message_are_ignored(kind):
    state = RunState("demo")
    whole = msgpack.unpackb(MESSAGES[kind])
    for name in whole:
        send(state, kind, msgpack.packb({k: v for k, v in whole.items() if k != name}))
        for invalid in INVALID_VALUES:
            try:
                message = msgpack.packb(whole | {name: invalid})
            except OverflowError:
                continue
            send(state, kind, message)
    for name in wire.decode_message(MESSAGES["trajectories"])[1]["variations"][0] if kind == "trajectories" else ():
        for invalid in INVALID_VALUES:
            broken = dict(whole["variations"][0]) | {name: invalid}
            with contextlib.suppress(OverflowError):
                send(state, kind, msgpack.packb(whole | {"variations": [broken]}))
    state.tick(1.0)
    text = json.dumps(state.snapshot(1.0), allow_nan=False)
    assert "\\u001b" not in text and sum(state.ignored.values()) > len(INVALID_VALUES)
    assert state.received > sum(state.ignored.values()), "valid messages are used"


INVALID_FIELDS = [
    ("learner", progress, {"phase": None}),
    ("learner", progress, {"phase": "x"}),
    ("learner", progress, {"stage": "finished"}),
    ("learner", progress, {"doing": [1]}),
    ("run", run_info, {"began": -1.7e308}),
    ("run", run_info, {"began": 3e11}),
    ("run", run_info, {"phases": [["pretrain", 0, -1]]}),
    ("event", lambda **invalid: event("finished", "x", **invalid), {"time": 1.7e308}),
    ("event", lambda **invalid: event("finished", "x", **invalid), {"time": -3e11}),
    ("event", lambda **invalid: event("version", "x", **invalid), {"version": -1}),
    ("event", lambda **invalid: event("quarantine", "x", **invalid), {"identity": "3/1"}),
]


@pytest.mark.parametrize(("kind", "message", "invalid"), INVALID_FIELDS)
def test_a_message_with_one_invalid_field_changes_nothing(kind, message, invalid):
    state = RunState("demo")
    send(state, "learner", progress())
    before = state.snapshot(2.0)
    send(state, kind, message(**invalid), 1.0)
    after = state.snapshot(2.0)
    assert after.pop("ignored") == {"schema": 1} and after.pop("heard") == before.pop("heard") + 1
    assert after == {name: value for name, value in before.items() if name != "ignored"}


@settings(max_examples=30, deadline=None)
@given(st.binary(max_size=200), st.text(max_size=20))
def test_any_bytes_are_ignored_without_an_error(payload, topic):
    state = RunState("demo")
    state.receive(f"icrl/{topic}/mon/x", payload, 0.0)
    state.receive(topic, payload, 0.0)
    state.tick(1.0)
    assert sum(state.ignored.values()) == state.received == 2


def test_a_message_beyond_the_size_limit_is_ignored():
    state = RunState("demo")
    send(state, "event", event("note", "x" * (2 << 20)))
    assert state.snapshot(0.0)["ignored"] == {"oversized": 1}


@pytest.mark.parametrize("kind", ["learner", "run", "event"])
def test_the_learners_messages_count_on_its_own_topics_only(kind):
    state = RunState("demo")
    send(state, "learner", progress())
    before = state.snapshot(2.0)
    for topic in (*(f"{topic}/w0" for topic in WORKER_TOPICS), "x", f"{kind}s"):
        send(state, topic, MESSAGES[kind] if kind != "event" else event("finished", "over"))
    after = state.snapshot(2.0)
    assert after.pop("ignored") == {"wrong topic": 6} and after.pop("heard") == before.pop("heard") + 6
    assert after == {name: value for name, value in before.items() if name != "ignored"}
