"""Round trips of every kind of message, and random changes to messages."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.stream import wire
from icrl_dist.stream.wire import WireError
from icrl_dist.types import ARRAYS, Trajectory
from tests.stream.examples import (
    ALL,
    ENCODED,
    JOB,
    LIMIT,
    VARIATIONS,
    ExamplePayload,
    decode,
    read_payload,
    trajectory,
    vectors,
    weights,
)


def test_a_decoded_trajectory_equals_the_encoded_one() -> None:
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


def test_the_digest_covers_everything_but_the_worker() -> None:
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


def test_decoded_weights_equal_the_encoded_ones() -> None:
    sent = weights()
    got = wire.decode_weights(wire.encode_weights(sent), LIMIT)
    assert (got.version, got.digest) == (sent.version, sent.digest)
    assert wire.weights_digest(dict(reversed(list(got.arrays.items())))) == sent.digest
    for name, array in sent.arrays.items():
        assert got.arrays[name].dtype == array.dtype and np.array_equal(got.arrays[name], array)


def test_a_decoded_job_equals_the_encoded_one_with_its_types() -> None:
    got = wire.decode_job(wire.encode_job(JOB), read_payload)
    assert got == JOB
    assert isinstance(got.payload, ExamplePayload)
    assert [type(v) for v in vars(got.payload).values()] == [float, int, str]
    assert [type(got.variations[1].task[name]) for name in ("mass", "scale")] == [float, int]


def test_a_decoded_message_equals_the_encoded_one() -> None:
    fields: dict[str, Any] = {
        "a": None,
        "b": True,
        "c": -(2**63),
        "d": 1.5,
        "e": "é",
        "f": b"\xff",
        "g": [1, [2.0, {"h": []}]],
        "i": {},
    }
    assert wire.decode_message(wire.encode_message("hello", **fields)) == ("hello", fields)


def test_every_truncation_of_every_message_is_refused() -> None:
    for data, read in [(wire.encode_trajectory(trajectory()), decode), *ENCODED.values()]:
        for cut in range(len(data)):
            with pytest.raises(WireError) as caught:
                read(data[:cut])
            assert caught.value.reason == "not-msgpack"


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(sorted(ALL)), st.binary(max_size=200))
def test_random_bytes_raise_only_wire_errors(kind: str, data: bytes) -> None:
    _attempt(kind, data)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_mutated_messages_raise_only_wire_errors(data: st.DataObject) -> None:
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
            inside[key] = data.draw(VALUES)
            break
    _attempt(kind, msgpack.packb(message))


def _attempt(kind: str, data: bytes) -> None:
    try:
        ALL[kind][1](data)
    except WireError as error:
        assert error.reason in wire.REASONS
