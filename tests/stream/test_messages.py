"""Requests and replies between workers and the learner: decoded strictly, refused with WireError."""

from __future__ import annotations

import typing
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from icrl_dist.stream import messages, wire
from icrl_dist.stream.schema import as_data
from icrl_dist.stream.validation import Stage, WireError, read
from icrl_dist.types import STAGES

RECORD = {"what": "raised", "worker": "w0", "job": "adapt/0/3/0", "exception": "x"}
COUNTS = {"episodes": 3, "steps": 24, "resent": 0, "trajectories": 3, "waited_s": 1.5}
VALID: dict[str, dict[str, Any]] = {
    "hello": {"worker": "w0", "version": "1", "code": "ab", "plugins": {"problems/toy": ["toys", "1.0", "cd"]}, "pid": 7},
    "ask": {"worker": "w0", **COUNTS},
    "failed": {"worker": "w0", "job": ["adapt", 0, 3, 0], "record": RECORD, "file": ""},
    "note": {"worker": "w0", "text": "hello"},
}
BAD: list[tuple[str, str, object]] = [
    ("hello", "pid", -1),
    ("hello", "version", None),
    ("hello", "plugins", {"problems/toy": ["toys", "1.0"]}),
    ("hello", "plugins", {"problems/toy": ["toys", "1.0", 3]}),
    ("ask", "worker", 3),
    ("ask", "steps", "x"),
    ("ask", "steps", 1.0),
    ("ask", "steps", True),
    ("ask", "waited_s", float("nan")),
    ("ask", "waited_s", -1),
    ("ask", "policy_version", -2),
    ("ask", "memory_mb", float("inf")),
    ("ask", "unknown", 1),
    ("failed", "job", ["later", 0, 3, 0]),
    ("failed", "job", ["adapt", 0, 3]),
    ("failed", "job", ["adapt", 0, 3, -1]),
    ("failed", "record", []),
    ("failed", "record", {1: 2}),
    ("failed", "record", {**RECORD, "unknown": 1}),
    ("failed", "record", {**RECORD, "exception": "x" * 1001}),
    ("failed", "record", {**RECORD, "traceback": "x" * 20_001}),
    ("failed", "record", {**RECORD, "spawn_key": [1] * 9}),
    ("failed", "file", b""),
    ("failed", "file", "../w0-1.json"),
    ("failed", "file", "w0\x00.json"),
    ("ask", "worker", ""),
    ("ask", "worker", "w" * 81),
    ("ask", "worker", "../w0"),
    ("ask", "worker", "w0\n"),
    ("ask", "worker", "\x1b[2J"),
    ("ask", "steps", 2**53 + 1),
    ("ask", "waited_s", 1e300),
    ("ask", "doing", "x" * 1001),
    ("note", "text", "x" * 1001),
    ("note", "text", 1),
]


def test_the_stages_of_the_annotation_are_those_of_the_types() -> None:
    assert typing.get_args(Stage) == STAGES


@pytest.mark.parametrize("kind", VALID)
def test_a_request_is_decoded_from_what_the_wire_carries(kind: str) -> None:
    found_kind, fields = wire.decode_message(wire.encode_message(kind, **VALID[kind]))
    request: Any = read(messages.REQUESTS[kind], fields, found_kind)
    decoded = as_data(request)
    if kind == "failed":
        decoded["record"] = {name: value for name, value in decoded["record"].items() if value is not None}
    assert decoded | VALID[kind] == decoded


@pytest.mark.parametrize(("kind", "name", "value"), BAD)
def test_an_invalid_field_is_refused(kind: str, name: str, value: object) -> None:
    with pytest.raises(WireError, match=f"schema: .*{kind}.{name}") as caught:
        read(messages.REQUESTS[kind], {**VALID[kind], name: value}, kind)
    assert caught.value.reason == "schema"


@pytest.mark.parametrize("kind", VALID)
def test_a_missing_field_is_refused(kind: str) -> None:
    for name in VALID[kind]:
        with pytest.raises(WireError, match=f"missing key {kind}.{name}"):
            read(messages.REQUESTS[kind], {k: v for k, v in VALID[kind].items() if k != name}, kind)


@given(
    st.sampled_from([*messages.REQUESTS.values(), messages.Welcome, messages.Wait, messages.LeasedJob]),
    st.dictionaries(
        st.sampled_from(sorted({name for fields in VALID.values() for name in fields})) | st.text(max_size=4),
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats()
        | st.text(max_size=4)
        | st.binary(max_size=4)
        | st.lists(st.integers()),
    ),
)
def test_any_fields_are_decoded_or_refused(cls: type, fields: dict[str, Any]) -> None:
    try:
        read(cls, fields, "message")
    except WireError as error:
        assert error.reason == "schema" and len(str(error)) < 600
