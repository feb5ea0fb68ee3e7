"""Malformed messages, each refused with its reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest

from icrl_dist.stream import wire
from icrl_dist.stream.wire import WireError
from icrl_dist.types import ARRAYS, Weights
from tests.stream.examples import ENCODED, JOB, decode, trajectory, vectors, weights


def repack(change: Callable[[dict[str, Any]], object], data: bytes | None = None) -> bytes:
    message: Any = msgpack.unpackb(data or wire.encode_trajectory(trajectory()))
    change(message)
    packed: bytes = msgpack.packb(message)
    return packed


def put(*path: Any) -> Callable[[dict[str, Any]], object]:
    """A change that replaces the value at a path; the last argument is the new value."""
    *keys, last, value = path

    def change(message: Any) -> None:
        for key in keys:
            message = message[key]
        message[last] = value

    return change


def array(name: str, shape: list[Any], content: bytes = b"", dtype: str | None = None) -> Callable[[dict[str, Any]], object]:
    return put("arrays", name, [dtype or ARRAYS[name][0], shape, content])


FOUR_PREV_ACTIONS, FOUR_PREV_REWARDS = ["<i2", [4], bytes(8)], ["<f4", [4], bytes(16)]
MALFORMED: list[tuple[str, str, bytes]] = [
    ("no bytes", "not-msgpack", b""),
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
    ("bytes as a key", "schema", repack(put(b"v", wire.VERSION))),
    ("no version", "version", repack(lambda m: m.pop("v"))),
    ("former version", "version", repack(put("v", wire.VERSION - 1))),
    ("next version", "version", repack(put("v", wire.VERSION + 1))),
    ("true as version", "version", repack(put("v", True))),
    ("float as version", "version", repack(put("v", float(wire.VERSION)))),
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
    ("fewer window actions than rewards", "shape", repack(array("prev_actions", [0]))),
    (
        "more window actions than queries",
        "shape",
        repack(lambda m: m["arrays"].update(prev_actions=FOUR_PREV_ACTIONS, prev_rewards=FOUR_PREV_REWARDS)),
    ),
    ("queries of three", "shape", repack(array("queries", [3, 3], bytes(36)))),
    ("vectors for numbers", "dtype", repack(array("actions", [5, 4], bytes(80), "<f4"))),
    ("numbers for vectors", "dtype", repack(array("actions", [5], bytes(10)), wire.encode_trajectory(vectors()))),
    ("a flat list of vectors", "shape", repack(array("actions", [20], bytes(80), "<f4"), wire.encode_trajectory(vectors()))),
    (
        "vectors of different lengths",
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
    ("weights", "of other arrays", "digest", wire.encode_weights(dataclasses.replace(weights(), digest="0" * 64))),
    ("weights", "one bit", "digest", repack(put("digest", "0" * 64), ENCODED["weights"][0])),
    ("weights", "renamed", "digest", repack(lambda m: m["arrays"].update(x=m["arrays"].pop("half")), ENCODED["weights"][0])),
    ("weights", "dtype", "dtype", repack(put("arrays", "half", ["<M8", [1], bytes(8)]), ENCODED["weights"][0])),
    ("weights", "rank", "shape", repack(put("arrays", "half", ["<f4", [1] * 9, bytes(4)]), ENCODED["weights"][0])),
    ("weights", "version", "schema", repack(put("version", -1), ENCODED["weights"][0])),
    ("job", "stage", "schema", repack(put("stage", None), ENCODED["job"][0])),
    ("job", "seed", "schema", repack(put("seed", -1), ENCODED["job"][0])),
    ("job", "variations", "schema", repack(put("variations", {}), ENCODED["job"][0])),
    ("job", "payload", "schema", repack(put("payload", [["a", 1, 2]]), ENCODED["job"][0])),
    ("job", "payload field", "schema", repack(put("payload", "count", 1.5), ENCODED["job"][0])),
    ("job", "payload key", "schema", repack(put("payload", "more", 1), ENCODED["job"][0])),
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


def test_the_limit_is_exact_to_the_byte() -> None:
    data = wire.encode_trajectory(trajectory())
    assert wire.decode_trajectory(data, len(data))
    with pytest.raises(WireError) as caught:
        wire.decode_trajectory(data, len(data) - 1)
    assert caught.value.reason == "oversized"


def test_invalid_values_are_refused_when_they_are_encoded() -> None:
    arrays = {"a": np.zeros(2, np.complex64)}
    cases: list[tuple[str, Callable[[], bytes]]] = [
        ("dtype", lambda: wire.encode_weights(Weights(0, arrays, wire.weights_digest(arrays)))),
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
