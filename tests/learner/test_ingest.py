"""Untrusted bytes on the data key: counted by reason, refused, and harmless."""

import dataclasses
import threading

import msgpack
import numpy as np
import pytest

from icrl_dist.collect import jobs
from icrl_dist.methods.recipes import METHODS
from icrl_dist.problems import registry
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.stream import batching, wire
from icrl_dist.types import Identity, Spec
from learner.ingest import REASONS, Inbox, Rejected, check


class Asked:
    """A query that remembers its answer."""

    key = "data"

    def __init__(self, payload):
        self.payload = payload
        self.answer = None
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
    return METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[0]


@pytest.fixture
def trajectories(job):
    return list(jobs.do(job, None, "w"))


@pytest.fixture
def inbox(tmp_path, small_run, job):
    store = Dataset(tmp_path)
    wanted = set(job.identities())
    failures = []
    made = Inbox(
        store,
        registry.spec(job.variations[0].task),
        1 << 20,
        lambda identity: job if identity in wanted else None,
        lambda version: "",
        lambda t: wanted.discard(t.identity),
        failures.append,
    )
    made.store, made.failures = store, failures
    yield made
    made.close()
    store.close()


def put(inbox, *payloads):
    """What became of the trajectories of one request: empty where stored, else why not."""
    query = Asked(batching.join(payloads))
    inbox.put(query)
    assert query.answered.wait(60)
    answers = batching.reasons(query.answer, len(payloads))
    return answers if len(answers) > 1 else answers[0]


def test_a_good_trajectory_is_on_disk_before_the_answer(inbox, trajectories, monkeypatch):
    order = []
    append = inbox.store.append
    monkeypatch.setattr(inbox.store, "append", lambda items: (append(items), order.append("stored")))
    reply = Asked.reply
    monkeypatch.setattr(Asked, "reply", lambda self, payload: (order.append("answered"), reply(self, payload)))
    put(inbox, wire.encode_trajectory(trajectories[0]))
    assert order == ["stored", "answered"]
    assert trajectories[0].identity in inbox.store


def test_a_duplicate_is_acknowledged_and_stored_once(inbox, trajectories):
    payload = wire.encode_trajectory(trajectories[0])
    assert put(inbox, payload) == put(inbox, payload) == ""
    assert len(inbox.store) == 1 and inbox.drops == {"duplicate": 1}
    pair = [Asked(wire.encode_trajectory(trajectories[1])) for _ in range(2)]
    inbox.take(pair)
    assert len(inbox.store) == 2 and [q.answer for q in pair] == [b"stored"] * 2


def broken(trajectory):
    """Every way to be wrong, and the reason it must be counted under."""
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
        ("spec", changed(taken=np.full(2, 5, np.int16), gained=np.zeros(2, np.float32))),
        ("spec", changed(taken=np.full(2, -1, np.int16), gained=np.zeros(2, np.float32))),
        ("not-finite", changed(taken=np.zeros(2, np.int16), gained=np.full(2, np.inf, np.float32))),
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


def test_bad_messages_are_counted_by_reason_refused_and_harm_nothing(inbox, trajectories):
    cases = broken(trajectories[0])
    for reason, payload in cases:
        before = inbox.drops[reason]
        answer = put(inbox, payload)
        assert answer.startswith(reason), (reason, answer)
        assert inbox.drops[reason] == before + 1
    assert len(inbox.store) == 0 and set(inbox.drops) <= set(REASONS)
    assert put(inbox, wire.encode_trajectory(trajectories[0])) == ""


def test_vectors_of_actions_are_held_to_the_spec(trajectories, job):
    spec = Spec((0.0, 0.0), (2.0, 2.0), 3, len(trajectories[0].actions), discrete=False)
    one, rng = trajectories[0], np.random.default_rng(0)
    shapes = {"actions": (len(one.actions), 3), "labels": (len(one.queries), 3), "taken": (len(one.taken), 3)}
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
        with pytest.raises(Rejected, match="of the other kind"):
            check(odd, job, other, "")


def test_each_trajectory_of_a_request_is_answered_for_itself(inbox, trajectories):
    good = [wire.encode_trajectory(t) for t in trajectories[:3]]
    answers = put(inbox, good[0], b"\xc1garbage", good[1], good[0], good[2])
    assert [bool(a) for a in answers] == [False, True, False, False, False]
    assert answers[1].startswith("not-msgpack")
    assert len(inbox.store) == 3 and inbox.drops == {"not-msgpack": 1, "duplicate": 1}


@pytest.mark.parametrize(
    ("reason", "payload"),
    [
        ("not-msgpack", b"\xc1garbage"),
        ("not-msgpack", b""),
        ("oversized", b"\0" * ((1 << 20) + 1)),
        ("schema", wire.encode_message("batch")),
        ("version", msgpack.packb({"v": 2, "kind": "batch", "items": []})),
    ],
)
def test_a_request_that_is_no_batch_is_refused_whole(inbox, reason, payload):
    query = Asked(payload)
    inbox.put(query)
    assert query.answer.startswith(reason) and inbox.drops == {reason: 1}


def test_a_full_queue_answers_busy_and_never_blocks(tmp_path, small_run, job, trajectories):
    gate = threading.Event()
    store = Dataset(tmp_path / "gated")
    inbox = Inbox(
        store,
        registry.spec(job.variations[0].task),
        1 << 20,
        lambda i: gate.wait() and job,
        lambda v: "",
        lambda t: None,
        print,
        capacity=2,
    )
    payload = wire.encode_trajectory(trajectories[0])
    queries = [Asked(batching.join([payload])) for _ in range(8)]
    for query in queries:
        inbox.put(query)
    busy = [q for q in queries if q.answer and batching.reasons(q.answer, 1) == ["busy"]]
    assert len(busy) >= 4 and inbox.drops["busy"] == len(busy)
    gate.set()
    assert all(q.answered.wait(60) for q in queries)
    inbox.close()
    store.close()


def test_the_queue_is_bounded_in_bytes_and_lets_one_in_however_large(tmp_path, small_run, job, trajectories):
    gate = threading.Event()
    store = Dataset(tmp_path / "gated")
    spec = registry.spec(job.variations[0].task)
    payloads = [wire.encode_trajectory(t) for t in trajectories[:4]]
    size = len(payloads[0])
    for room, expected in ((2 * size + size // 2, 2), (size // 2, 1)):
        gate.clear()
        inbox = Inbox(
            store, spec, 1 << 20, lambda i: gate.wait() and job, lambda v: "", lambda t: None, print, capacity_bytes=room
        )
        query = Asked(batching.join(payloads))
        inbox.put(query)
        assert inbox.drops == {"busy": 4 - expected}
        gate.set()
        assert query.answered.wait(60)
        assert batching.reasons(query.answer, 4) == [""] * expected + ["busy"] * (4 - expected)
        inbox.close()  # what was taken in is done with, so there is room again
        assert inbox._room._count == inbox._room._size == 0
    store.close()


def test_numbers_that_the_ledger_cannot_hold_are_refused_and_harm_nothing(inbox, trajectories):
    message = msgpack.unpackb(wire.encode_trajectory(trajectories[0]))
    for number in (1 << 31, (1 << 64) - 1):
        message["identity"][4] = number
        assert put(inbox, msgpack.packb(message)).startswith("schema: identity")
    assert put(inbox, wire.encode_trajectory(trajectories[0])) == "" and inbox.failures == []


def test_large_numbers_are_finite(inbox, trajectories):
    rewards = np.full_like(trajectories[0].rewards, 3e38)
    assert put(inbox, wire.encode_trajectory(dataclasses.replace(trajectories[0], rewards=rewards))) == ""
    assert inbox.commits == 1


def test_a_full_disk_acknowledges_nothing_and_is_reported(inbox, trajectories, monkeypatch):
    def full(items):
        raise StoreError("segment: could not be written (No space left on device)")

    monkeypatch.setattr(inbox.store, "append", full)
    query = Asked(batching.join([wire.encode_trajectory(trajectories[0])]))
    inbox.put(query)
    inbox._thread.join(60)
    assert query.answer is None and "No space left" in str(inbox.failures[0])


def test_a_failed_inbox_closes_even_with_a_full_queue(tmp_path, small_run, job, trajectories):
    failures = []

    def bug(identity):
        raise ZeroDivisionError("a bug")

    store = Dataset(tmp_path / "bug")
    spec = registry.spec(job.variations[0].task)
    inbox = Inbox(store, spec, 1 << 20, bug, lambda v: "", lambda t: None, failures.append, capacity=2)
    payload = wire.encode_trajectory(trajectories[0])
    for _ in range(20):
        inbox.put(Asked(batching.join([payload])))
    inbox.close()
    assert [type(f) for f in failures] == [ZeroDivisionError]
    store.close()
