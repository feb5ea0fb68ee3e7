"""The ingest: invalid messages are refused and counted by reason, valid trajectories are stored before the reply."""

import dataclasses
import threading
from typing import Any

import msgpack
import numpy as np
import pytest

from icrl_dist.collect.checks import Rejected, check
from icrl_dist.problems import registry
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.stream import batching, wire
from icrl_dist.types import Identity, Spec
from learner.ingest import REASONS, Ingest
from tests.calls import noting
from tests.jobs import do, jobs_of


class FakeQuery:
    """A query that keeps its answer."""

    key = "data"

    def __init__(self, payload):
        self.payload = payload
        self.answer: Any = None
        self.answered = threading.Event()

    def reply(self, payload):
        assert self.answer is None
        self.answer = payload
        self.answered.set()

    def refuse(self, reason):
        assert self.answer is None
        self.answer = reason
        self.answered.set()


@pytest.fixture
def job(small_run):
    return jobs_of(small_run, "icag")[0]


@pytest.fixture
def trajectories(small_run, job):
    return do(small_run, job)


class ObservedIngest(Ingest):
    """An Ingest with its dataset and the failures that it reported."""

    store: Dataset
    failures: list[BaseException]


@pytest.fixture
def ingest(tmp_path, small_run, job):
    store = Dataset(tmp_path)
    wanted = set(job.identities())
    failures = list[BaseException]()
    opened = ObservedIngest(
        store,
        registry.spec(job.variations[0].task),
        1 << 20,
        lambda identity: job if identity in wanted else None,
        lambda version: "",
        lambda t: wanted.discard(t.identity),
        failures.append,
    )
    opened.store, opened.failures = store, failures
    yield opened
    opened.close()
    store.close()


def put(ingest, *payloads):
    """Send one request; returns for each trajectory an empty text, or the reason for which it was not stored."""
    query = FakeQuery(batching.join(payloads))
    ingest.put(query)
    assert query.answered.wait(60)
    answers = batching.reasons(query.answer, len(payloads))
    return answers if len(answers) > 1 else answers[0]


def test_a_trajectory_is_stored_before_the_answer(ingest, trajectories, monkeypatch):
    order = list[str]()
    append = ingest.store.append

    def stored(items):
        append(items)
        order.append("stored")

    monkeypatch.setattr(ingest.store, "append", stored)
    monkeypatch.setattr(FakeQuery, "reply", noting(order, lambda self, payload: "answered", FakeQuery.reply))
    put(ingest, wire.encode_trajectory(trajectories[0]))
    assert order == ["stored", "answered"]
    assert trajectories[0].identity in ingest.store


def test_a_duplicate_is_acknowledged_and_stored_once(ingest, trajectories):
    payload = wire.encode_trajectory(trajectories[0])
    assert put(ingest, payload) == put(ingest, payload) == ""
    assert len(ingest.store) == 1 and ingest.drops == {"duplicate": 1}
    pair = [FakeQuery(wire.encode_trajectory(trajectories[1])) for _ in range(2)]
    ingest.take(pair)
    assert len(ingest.store) == 2 and [q.answer for q in pair] == [b"stored"] * 2


def invalid(trajectory):
    """Invalid messages of every kind, each with the reason under which it is counted."""
    good = wire.encode_trajectory(trajectory)
    nan = trajectory.rewards.copy()
    nan[0] = np.nan
    far = trajectory.actions.copy()
    far[0] = 5

    def changed(**fields):
        return wire.encode_trajectory(dataclasses.replace(trajectory, **fields))

    short = {name: getattr(trajectory, name)[:4] for name in ("actions", "rewards", "adversary")}
    return [
        ("not-msgpack", b"\xc1garbage"),
        ("not-msgpack", b""),
        ("not-msgpack", good[:-1]),
        ("schema", wire.encode_message("trajectory")),
        ("not-finite", changed(rewards=nan)),
        ("spec", changed(observations=trajectory.observations[:5], **short)),
        ("spec", changed(actions=far)),
        ("spec", changed(labels=trajectory.labels[:, :4])),
        ("spec", changed(prev_actions=np.full(2, 5, np.int16), prev_rewards=np.zeros(2, np.float32))),
        ("spec", changed(prev_actions=np.full(2, -1, np.int16), prev_rewards=np.zeros(2, np.float32))),
        ("not-finite", changed(prev_actions=np.zeros(2, np.int16), prev_rewards=np.full(2, np.inf, np.float32))),
        ("spec", changed(worker="\x1b[2J")),
        ("spec", changed(worker="w" * 10_000)),
        ("unexpected", changed(identity=Identity("adapt", 7, 0, 0, 0))),
        (
            "unexpected",
            changed(
                variation=dataclasses.replace(trajectory.variation, task=trajectory.variation.task.replace(goal=(0, 0), size=4))
            ),
        ),
        ("stale-weights", changed(policy_version=3)),
        ("stale-weights", changed(weights_digest="f" * 64)),
    ]


def test_invalid_messages_are_refused_and_counted_by_reason(ingest, trajectories):
    cases = invalid(trajectories[0])
    for reason, payload in cases:
        before = ingest.drops[reason]
        answer = put(ingest, payload)
        assert answer.startswith(reason), (reason, answer)
        assert ingest.drops[reason] == before + 1
    assert len(ingest.store) == 0 and set(ingest.drops) <= set(REASONS)
    assert put(ingest, wire.encode_trajectory(trajectories[0])) == ""


def test_continuous_actions_are_checked_against_the_spec(trajectories, job):
    spec = Spec((0.0, 0.0), (2.0, 2.0), 3, len(trajectories[0].actions), discrete=False)
    one, rng = trajectories[0], np.random.default_rng(0)
    shapes = {"actions": (len(one.actions), 3), "labels": (len(one.queries), 3), "prev_actions": (len(one.prev_actions), 3)}
    arrays = {name: rng.uniform(-1, 1, shape).astype(np.float32) for name, shape in shapes.items()}
    good = dataclasses.replace(one, adversary=np.zeros((len(one.actions), 2), np.float32), **arrays)
    check(good, job, spec, "")
    for name, array in arrays.items():
        if len(array):
            far = array.copy()
            far[-1, -1] = 1.01
            with pytest.raises(Rejected, match=r"outside -1\.\.1"):
                check(dataclasses.replace(good, **{name: far}), job, spec, "")
            far[-1, -1] = np.nan
            with pytest.raises(Rejected, match="not-finite"):
                check(dataclasses.replace(good, **{name: far}), job, spec, "")
    with pytest.raises(Rejected, match=r"spec.*labels"):
        check(good, job, dataclasses.replace(spec, actions=4), "")
    for odd, other in ((one, dataclasses.replace(spec, actions=5)), (good, dataclasses.replace(spec, discrete=True))):
        with pytest.raises(Rejected, match=r"this run has (discrete|continuous) actions"):
            check(odd, job, other, "")


def test_each_trajectory_of_a_request_has_its_own_answer(ingest, trajectories):
    good = [wire.encode_trajectory(t) for t in trajectories[:3]]
    answers = put(ingest, good[0], b"\xc1garbage", good[1], good[0], good[2])
    assert [bool(a) for a in answers] == [False, True, False, False, False]
    assert answers[1].startswith("not-msgpack")
    assert len(ingest.store) == 3 and ingest.drops == {"not-msgpack": 1, "duplicate": 1}


@pytest.mark.parametrize(
    ("reason", "payload"),
    [
        ("not-msgpack", b"\xc1garbage"),
        ("not-msgpack", b""),
        ("oversized", b"\0" * ((1 << 20) + 1)),
        ("schema", wire.encode_message("batch")),
        ("version", msgpack.packb({"v": wire.VERSION + 1, "kind": "batch", "items": []})),
    ],
)
def test_a_request_that_is_not_a_batch_is_refused(ingest, reason, payload):
    query = FakeQuery(payload)
    ingest.put(query)
    assert query.answer.startswith(reason) and ingest.drops == {reason: 1}


def behind(gate, job):
    """An answer to which job wants a trajectory, given once the gate is open."""

    def wanted_by(identity):
        gate.wait()
        return job

    return wanted_by


def test_a_full_queue_answers_busy_and_never_blocks(tmp_path, small_run, job, trajectories):
    gate = threading.Event()
    store = Dataset(tmp_path / "gated")
    ingest = Ingest(
        store,
        registry.spec(job.variations[0].task),
        1 << 20,
        behind(gate, job),
        lambda v: "",
        lambda t: None,
        print,
        capacity=2,
    )
    payload = wire.encode_trajectory(trajectories[0])
    queries = [FakeQuery(batching.join([payload])) for _ in range(8)]
    for query in queries:
        ingest.put(query)
    busy = [q for q in queries if q.answer and batching.reasons(q.answer, 1) == ["busy"]]
    assert len(busy) >= 4 and ingest.drops["busy"] == len(busy)
    gate.set()
    assert all(q.answered.wait(60) for q in queries)
    ingest.close()
    store.close()


def test_the_queue_is_bounded_in_bytes_and_accepts_one_message_of_any_size(tmp_path, small_run, job, trajectories):
    gate = threading.Event()
    store = Dataset(tmp_path / "gated")
    spec = registry.spec(job.variations[0].task)
    payloads = [wire.encode_trajectory(t) for t in trajectories[:4]]
    size = len(payloads[0])
    for capacity, expected in ((2 * size + size // 2, 2), (size // 2, 1)):
        gate.clear()
        ingest = Ingest(store, spec, 1 << 20, behind(gate, job), lambda v: "", lambda t: None, print, capacity_bytes=capacity)
        query = FakeQuery(batching.join(payloads))
        ingest.put(query)
        assert ingest.drops == {"busy": 4 - expected}
        gate.set()
        assert query.answered.wait(60)
        assert batching.reasons(query.answer, 4) == [""] * expected + ["busy"] * (4 - expected)
        ingest.close()  # waits until the queued messages are answered
        assert ingest._load._count == ingest._load._size == 0
    store.close()


def test_numbers_too_large_for_the_ledger_are_refused(ingest, trajectories):
    message = msgpack.unpackb(wire.encode_trajectory(trajectories[0]))
    for number in (1 << 31, (1 << 64) - 1):
        message["identity"][4] = number
        assert put(ingest, msgpack.packb(message)).startswith("schema: identity")
    assert put(ingest, wire.encode_trajectory(trajectories[0])) == "" and ingest.failures == []


def test_the_largest_float32_values_are_out_of_bounds(ingest, trajectories):
    rewards = np.full_like(trajectories[0].rewards, 3e38)
    answer = put(ingest, wire.encode_trajectory(dataclasses.replace(trajectories[0], rewards=rewards)))
    assert "rewards[0] = 3e+38 lies outside -1e+06..1e+06" in answer and ingest.commits == 0


def test_on_a_full_disk_nothing_is_acknowledged_and_the_error_is_reported(ingest, trajectories, monkeypatch):
    def full(items):
        raise StoreError("segment: could not be written (No space left on device)")

    monkeypatch.setattr(ingest.store, "append", full)
    query = FakeQuery(batching.join([wire.encode_trajectory(trajectories[0])]))
    ingest.put(query)
    ingest._thread.join(60)
    assert query.answer is None and "No space left" in str(ingest.failures[0])


def test_a_failed_ingest_can_be_closed_with_a_full_queue(tmp_path, small_run, job, trajectories):
    failures = list[BaseException]()

    def bug(identity):
        raise ZeroDivisionError("a bug")

    store = Dataset(tmp_path / "bug")
    spec = registry.spec(job.variations[0].task)
    ingest = Ingest(store, spec, 1 << 20, bug, lambda v: "", lambda t: None, failures.append, capacity=2)
    payload = wire.encode_trajectory(trajectories[0])
    for _ in range(20):
        ingest.put(FakeQuery(batching.join([payload])))
    ingest.close()
    assert [type(f) for f in failures] == [ZeroDivisionError]
    store.close()
