"""Round trips, and every way in which a message can be wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.stream import wire
from icrl_dist.stream.wire import WireError
from icrl_dist.types import ARRAYS, NULL, Adversary, Identity, Job, Task, Trajectory, Variation, Weights

LIMIT = 1 << 20

VARIATIONS = (
    Variation(Task.of("darkroom", goal=(3, 4), size=10, horizon=100), NULL),
    Variation(Task.of("dmc", problem="walker-run", mass=5.0, scale=5), Adversary.of("override", alpha=(0.5, 2.0), p=0.1)),
    Variation(Task("empty"), Adversary.of("force", vector=(), seed=2**63, low=-1)),
)


def trajectory(steps: int = 5, queries: int = 3, variation: Variation = VARIATIONS[1]) -> Trajectory:
    rng = np.random.default_rng(steps)
    return Trajectory(
        identity=Identity("adapt", 0, 3, 1, 7),
        variation=variation,
        policy_version=2,
        weights_digest="ab",
        worker="w0",
        observations=rng.normal(size=(steps + 1, 2)).astype(np.float32),
        actions=rng.integers(0, 5, steps).astype(np.int16),
        rewards=rng.normal(size=steps).astype(np.float32),
        adversary=np.full(steps, -1, np.int16),
        queries=rng.normal(size=(queries, 2)).astype(np.float32),
        labels=rng.random((queries, 5)).astype(np.float32),
        taken=rng.integers(0, 5, queries // 2).astype(np.int16),
        gained=rng.normal(size=queries // 2).astype(np.float32),
        origin="optimal",
    )


def vectors(steps: int = 5, queries: int = 3) -> Trajectory:
    """A trajectory of a game with four-dimensional actions, pushed in three components."""
    rng = np.random.default_rng(steps)
    shapes = {"actions": (steps, 4), "adversary": (steps, 3), "taken": (queries // 2, 4), "labels": (queries, 4)}
    arrays = {name: rng.uniform(-1, 1, shape).astype(np.float32) for name, shape in shapes.items()}
    return dataclasses.replace(trajectory(steps, queries), origin="expert", **arrays)


def weights() -> Weights:
    rng = np.random.default_rng(0)
    arrays = {
        "embed.weight": rng.normal(size=(4, 3)).astype(np.float32),
        "scale": np.array(2.0, np.float64),
        "half": np.ones((2, 1, 2), np.float16),
        "none": np.zeros((0, 3), np.int64),
    }
    return Weights(3, arrays, wire.weights_digest(arrays))


JOB = Job("adapt", "adapt", 1, 2, VARIATIONS, 4, 0, 2**40, (("beta", 1.0), ("count", 1), ("name", "x")), tasks=1, first=3)

ENCODED: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
    "weights": (wire.encode_weights(weights()), lambda data: wire.decode_weights(data, LIMIT)),
    "job": (wire.encode_job(JOB), lambda data: wire.decode_job(data, LIMIT)),
    "message": (wire.encode_message("hello", a=[1, {"b": None}], c=b"x"), lambda data: wire.decode_message(data, LIMIT)),
}


def decode(data: bytes) -> Trajectory:
    return wire.decode_trajectory(data, LIMIT)


def test_a_trajectory_comes_back_as_it_was() -> None:
    discrete = [(5, 3, VARIATIONS[0]), (1, 0, VARIATIONS[1]), (100, 1, VARIATIONS[2])]
    for sent in [*(trajectory(*sizes) for sizes in discrete), vectors(), vectors(1, 0)]:
        got = decode(wire.encode_trajectory(sent))
        for field in dataclasses.fields(Trajectory):
            if field.name not in ARRAYS:
                assert getattr(got, field.name) == getattr(sent, field.name)
        for name, array in sent.arrays().items():
            found = getattr(got, name)
            assert found.dtype == array.dtype and found.shape == array.shape and found.tobytes() == array.tobytes()
            assert not found.flags.writeable
        assert wire.encode_trajectory(got) == wire.encode_trajectory(sent)
        assert wire.trajectory_digest(got) == wire.trajectory_digest(sent)


def test_arrays_need_not_be_contiguous() -> None:
    whole = trajectory()
    strided = dataclasses.replace(whole, observations=np.asfortranarray(whole.observations))
    assert wire.encode_trajectory(strided) == wire.encode_trajectory(whole)
    assert wire.trajectory_digest(strided) == wire.trajectory_digest(whole)


def test_the_digest_is_of_what_happened_and_not_of_who_ran_it() -> None:
    one = trajectory()
    assert wire.trajectory_digest(dataclasses.replace(one, worker="w1")) == wire.trajectory_digest(one)
    rewards = one.rewards.copy()
    rewards[2] = np.nextafter(rewards[2], np.float32(9))
    for change in (
        {"identity": one.identity._replace(trial=8)},
        {"variation": VARIATIONS[0]},
        {"policy_version": 3},
        {"weights_digest": "ac"},
        {"origin": "none"},
        {"rewards": rewards},
    ):
        assert wire.trajectory_digest(dataclasses.replace(one, **change)) != wire.trajectory_digest(one)


def test_weights_come_back_as_they_were() -> None:
    sent = weights()
    got = wire.decode_weights(wire.encode_weights(sent), LIMIT)
    assert (got.version, got.digest) == (sent.version, sent.digest)
    assert wire.weights_digest(dict(reversed(got.arrays.items()))) == sent.digest
    for name, array in sent.arrays.items():
        assert got.arrays[name].dtype == array.dtype and np.array_equal(got.arrays[name], array)


def test_a_job_comes_back_equal_with_its_types() -> None:
    got = wire.decode_job(wire.encode_job(JOB))
    assert got == JOB
    assert [type(v) for _, v in got.settings] == [float, int, str]
    assert [type(got.variations[1].task[name]) for name in ("mass", "scale")] == [float, int]


def test_a_message_comes_back_as_it_was() -> None:
    fields = {"a": None, "b": True, "c": -(2**63), "d": 1.5, "e": "é", "f": b"\xff", "g": [1, [2.0, {"h": []}]], "i": {}}
    assert wire.decode_message(wire.encode_message("hello", **fields)) == ("hello", fields)


def test_every_cut_of_every_message_is_refused() -> None:
    for data, read in [(wire.encode_trajectory(trajectory()), decode), *ENCODED.values()]:
        for cut in range(len(data)):
            with pytest.raises(WireError) as caught:
                read(data[:cut])
            assert caught.value.reason == "not-msgpack"


def repack(change: Callable[[dict[str, Any]], object], data: bytes | None = None) -> bytes:
    message: Any = msgpack.unpackb(data or wire.encode_trajectory(trajectory()))
    change(message)
    packed: bytes = msgpack.packb(message)
    return packed


def put(*path: Any) -> Callable[[dict[str, Any]], object]:
    """Replace what is at the path by its last entry."""
    *keys, last, value = path

    def change(message: Any) -> None:
        for key in keys:
            message = message[key]
        message[last] = value

    return change


def array(name: str, shape: list[Any], content: bytes = b"", dtype: str | None = None) -> Callable[[dict[str, Any]], object]:
    return put("arrays", name, [dtype or ARRAYS[name][0], shape, content])


FOUR_TAKEN, FOUR_GAINED = ["<i2", [4], bytes(8)], ["<f4", [4], bytes(16)]
MALFORMED: list[tuple[str, str, bytes]] = [
    ("nothing", "not-msgpack", b""),
    ("never used byte", "not-msgpack", b"\xc1"),
    ("two values", "not-msgpack", wire.encode_message("x") * 2),
    ("list as a key", "not-msgpack", b"\x81\x90\x01"),
    ("integer as a key", "not-msgpack", b"\x81\x01\x01"),
    ("huge list", "not-msgpack", b"\xdd\xff\xff\xff\xff" + bytes(20)),
    ("huge map", "not-msgpack", b"\xdf\xff\xff\xff\xff" + bytes(20)),
    ("huge bytes", "not-msgpack", b"\xc6\xff\xff\xff\xff" + bytes(20)),
    ("nested for ever", "not-msgpack", b"\x91" * 100_000 + b"\x01"),
    ("wide and nested", "not-msgpack", b"\xdc\x40\x00" * 10_000),
    ("bad text", "not-msgpack", b"\x81\xa1v\xa1\xff"),
    ("timestamp", "not-msgpack", b"\x81\xa1v\xd6\xff" + bytes(4)),
    ("extension", "not-msgpack", repack(put("worker", msgpack.ExtType(5, b"x")))),
    ("empty extension", "not-msgpack", b"\x81\xa1v\xc7\x00\x05"),
    ("not a map", "schema", b"\x01"),
    ("bytes as a key", "schema", repack(put(b"v", 1))),
    ("no version", "version", repack(lambda m: m.pop("v"))),
    ("next version", "version", repack(put("v", 2))),
    ("true as version", "version", repack(put("v", True))),
    ("float as version", "version", repack(put("v", 1.0))),
    ("another kind", "schema", wire.encode_job(JOB)),
    ("missing field", "schema", repack(lambda m: m.pop("worker"))),
    ("unknown field", "schema", repack(put("extra", 1))),
    ("unknown stage", "schema", repack(put("identity", 0, "later"))),
    ("list as stage", "schema", repack(put("identity", 0, []))),
    ("short identity", "schema", repack(put("identity", ["adapt", 0, 3, 1]))),
    ("empty identity", "schema", repack(put("identity", []))),
    ("negative trial", "schema", repack(put("identity", 4, -1))),
    ("true as trial", "schema", repack(put("identity", 4, True))),
    ("weights -2", "schema", repack(put("policy_version", -2))),
    ("weights 1.0", "schema", repack(put("policy_version", 1.0))),
    ("no worker", "schema", repack(put("worker", None))),
    ("long worker", "not-msgpack", repack(put("worker", "x" * 100_000))),
    ("three in a variation", "schema", repack(put("variation", [["a", []]] * 3))),
    ("parameter of None", "schema", repack(put("variation", 0, ["a", [["b", None]]]))),
    ("parameter of lists", "schema", repack(put("variation", 0, ["a", [["b", [[1]]]]]))),
    ("parameter of text", "schema", repack(put("variation", 0, ["a", [["b", ["x"]]]]))),
    ("parameter without value", "schema", repack(put("variation", 0, ["a", [["b"]]]))),
    ("array missing", "schema", repack(lambda m: m["arrays"].pop("queries"))),
    ("array unknown", "schema", repack(put("arrays", "more", []))),
    ("array without bytes", "schema", repack(put("arrays", "actions", ["<i2", [5]]))),
    ("array of text", "schema", repack(put("arrays", "actions", ["<i2", [5], "0123456789"]))),
    ("negative size", "schema", repack(array("actions", [-5], bytes(10)))),
    ("float size", "schema", repack(array("actions", [5.0], bytes(10)))),
    ("object dtype", "dtype", repack(array("actions", [5], bytes(40), "|O"))),
    ("other dtype", "dtype", repack(array("actions", [5], bytes(20), "<i4"))),
    ("big-endian", "dtype", repack(array("actions", [5], bytes(10), ">i2"))),
    ("structured dtype", "dtype", repack(array("actions", [5], bytes(10), "i2,i2"))),
    ("few bytes", "shape", repack(array("actions", [5], bytes(8)))),
    ("overflowing shape", "shape", repack(array("observations", [2**63, 2]))),
    ("vast empty shape", "shape", repack(array("queries", [0, 2**63]))),
    ("two dimensions", "shape", repack(array("actions", [5, 1], bytes(10)))),
    ("four actions", "shape", repack(array("actions", [4], bytes(8)))),
    ("four rewards", "shape", repack(array("rewards", [4], bytes(16)))),
    ("two labels", "shape", repack(array("labels", [2, 5], bytes(40)))),
    ("nothing taken but something gained", "shape", repack(array("taken", [0]))),
    ("more taken than asked", "shape", repack(lambda m: m["arrays"].update(taken=FOUR_TAKEN, gained=FOUR_GAINED))),
    ("queries of three", "shape", repack(array("queries", [3, 3], bytes(36)))),
    ("vectors for numbers", "dtype", repack(array("actions", [5, 4], bytes(80), "<f4"))),
    ("numbers for vectors", "dtype", repack(array("actions", [5], bytes(10)), wire.encode_trajectory(vectors()))),
    ("a flat list of vectors", "shape", repack(array("actions", [20], bytes(80), "<f4"), wire.encode_trajectory(vectors()))),
    (
        "vectors of unlike components",
        "shape",
        repack(array("actions", [5, 3], bytes(60), "<f4"), wire.encode_trajectory(vectors())),
    ),
    ("an adversary of numbers", "dtype", repack(array("adversary", [5], bytes(10)), wire.encode_trajectory(vectors()))),
]


@pytest.mark.parametrize(("reason", "data"), [case[1:] for case in MALFORMED], ids=[case[0] for case in MALFORMED])
def test_a_malformed_trajectory_is_refused_with_its_reason(reason: str, data: bytes) -> None:
    with pytest.raises(WireError) as caught:
        decode(data)
    assert caught.value.reason == reason in wire.REASONS
    assert str(caught.value) == f"{reason}: {caught.value.detail}" and len(str(caught.value)) < 500


MALFORMED_OTHERS: list[tuple[str, str, str, bytes]] = [
    ("weights", "one bit", "digest", repack(put("digest", "0" * 64), ENCODED["weights"][0])),
    ("weights", "renamed", "digest", repack(lambda m: m["arrays"].update(x=m["arrays"].pop("half")), ENCODED["weights"][0])),
    ("weights", "dtype", "dtype", repack(put("arrays", "half", ["<M8", [1], bytes(8)]), ENCODED["weights"][0])),
    ("weights", "rank", "shape", repack(put("arrays", "half", ["<f4", [1] * 9, bytes(4)]), ENCODED["weights"][0])),
    ("weights", "version", "schema", repack(put("version", -1), ENCODED["weights"][0])),
    ("job", "stage", "schema", repack(put("stage", None), ENCODED["job"][0])),
    ("job", "seed", "schema", repack(put("seed", -1), ENCODED["job"][0])),
    ("job", "variations", "schema", repack(put("variations", {}), ENCODED["job"][0])),
    ("job", "settings", "schema", repack(put("settings", [["a", 1, 2]]), ENCODED["job"][0])),
    ("message", "kind", "schema", repack(put("kind", 3), ENCODED["message"][0])),
    ("message", "no kind", "schema", repack(lambda m: m.pop("kind"), ENCODED["message"][0])),
    ("message", "deep", "schema", repack(put("a", [[[[[[[[[1]]]]]]]]]), ENCODED["message"][0])),
    ("message", "keys", "schema", repack(put("a", {b"k": 1}), ENCODED["message"][0])),
]


@pytest.mark.parametrize(("kind", "reason", "data"), [(k, r, d) for k, _, r, d in MALFORMED_OTHERS])
def test_other_malformed_messages_are_refused_with_their_reason(kind: str, reason: str, data: bytes) -> None:
    with pytest.raises(WireError) as caught:
        ENCODED[kind][1](data)
    assert caught.value.reason == reason


def test_the_limit_is_to_the_byte() -> None:
    data = wire.encode_trajectory(trajectory())
    assert wire.decode_trajectory(data, len(data))
    with pytest.raises(WireError) as caught:
        wire.decode_trajectory(data, len(data) - 1)
    assert caught.value.reason == "oversized"


def test_a_producers_mistakes_are_refused_at_home() -> None:
    arrays = {"a": np.zeros(2, np.complex64)}
    cases: list[tuple[str, Callable[[], bytes]]] = [
        ("dtype", lambda: wire.encode_weights(Weights(0, arrays, wire.weights_digest(arrays)))),
        ("digest", lambda: wire.encode_weights(Weights(0, {}, ""))),
        ("schema", lambda: wire.encode_message("x", a=np.float64(1.0))),
        ("schema", lambda: wire.encode_message("x", a=(1, 2))),
        ("schema", lambda: wire.encode_message("x", a={1: 2})),
        ("schema", lambda: wire.encode_message("x", a=2**64)),
        ("schema", lambda: wire.encode_message("x", a="\ud800")),
        ("schema", lambda: wire.encode_message("x", v=2)),
        ("schema", lambda: wire.encode_job(dataclasses.replace(JOB, seed=2**70))),
    ]
    short = trajectory()
    object.__setattr__(short, "rewards", short.rewards[1:])
    cases.append(("shape", lambda: wire.encode_trajectory(short)))
    wide = trajectory()
    object.__setattr__(wide, "rewards", wide.rewards.astype(np.float64))
    cases.append(("dtype", lambda: wire.encode_trajectory(wide)))
    uneven = vectors()
    object.__setattr__(uneven, "labels", np.zeros((3, 2), np.float32))
    cases.append(("shape", lambda: wire.encode_trajectory(uneven)))
    mixed = vectors()
    object.__setattr__(mixed, "adversary", np.full(5, -1, np.int16))
    cases.append(("dtype", lambda: wire.encode_trajectory(mixed)))
    for reason, encode in cases:
        with pytest.raises(WireError) as caught:
            encode()
        assert caught.value.reason == reason


ALL = {
    "trajectory": (wire.encode_trajectory(trajectory()), decode),
    "vectors": (wire.encode_trajectory(vectors()), decode),
    **ENCODED,
}


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(sorted(ALL)), st.binary(max_size=200))
def test_random_bytes_never_raise_anything_else(kind: str, data: bytes) -> None:
    _attempt(kind, data)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_mutated_messages_never_raise_anything_else(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(sorted(ALL)))
    if data.draw(st.booleans()):
        mutated = bytearray(ALL[kind][0])
        for _ in range(data.draw(st.integers(1, 4))):
            mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
        _attempt(kind, bytes(mutated))
        return
    message: Any = msgpack.unpackb(ALL[kind][0])
    inside = message
    while True:
        keys = sorted(inside) if isinstance(inside, dict) else list(range(len(inside)))
        key = data.draw(st.sampled_from(keys))
        if isinstance(inside[key], (dict, list)) and inside[key] and data.draw(st.booleans()):
            inside = inside[key]
        else:
            inside[key] = data.draw(PLAIN)
            break
    _attempt(kind, msgpack.packb(message))


def _attempt(kind: str, data: bytes) -> None:
    try:
        ALL[kind][1](data)
    except WireError as error:
        assert error.reason in wire.REASONS
