"""Hostile bytes: every reader gives a value or a refusal, within its memory limit.

``corpus/`` holds inputs that fuzzing found.  The reader in the name of a file must refuse
``refused-*`` and accept ``accepted-*``; the other readers must accept or refuse it without an error.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from icrl_dist.bench import fuzz
from icrl_dist.bench.mutations import mutate
from icrl_dist.stream import excerpts, validation, wire

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.bin"))
TARGETS = fuzz.targets()


@pytest.fixture
def measured() -> Iterator[None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: file.stem)
def test_every_file_of_the_corpus(file: Path, measured: None) -> None:
    expected, reader, _ = file.stem.split("-", 2)
    data = file.read_bytes()
    for name, target in TARGETS.items():
        outcome, _, ratio = fuzz.attempt(target, data)
        assert outcome in ("accepted", "rejected") and ratio <= 1, name
        if name == reader:
            assert outcome == {"refused": "rejected", "accepted": "accepted"}[expected]


def test_the_corpus_is_not_empty() -> None:
    assert len(CORPUS) >= 15


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(sorted(TARGETS)), seed=st.integers(0, 2**63))
def test_mutated_messages(name: str, seed: int, measured: None) -> None:
    target = TARGETS[name]
    outcome, _, ratio = fuzz.attempt(target, mutate(np.random.default_rng(seed), target.valid))
    assert outcome in ("accepted", "rejected") and ratio <= 1


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(sorted(TARGETS)), data=st.binary(max_size=2000))
def test_random_bytes(name: str, data: bytes, measured: None) -> None:
    outcome, _, ratio = fuzz.attempt(TARGETS[name], data)
    assert outcome in ("accepted", "rejected") and ratio <= 1


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20) | st.binary(max_size=20),
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(st.text(max_size=5), inside, max_size=4),
    max_leaves=12,
)


@settings(max_examples=100, deadline=None)
@given(VALUES)
def test_every_value_that_can_be_encoded_is_decoded_equal(value: object) -> None:
    try:
        data = wire.encode_message("any", value=value)
    except wire.WireError as error:
        assert error.reason == "schema"  # nested deeper than 8, or text that is not Unicode
        return
    _, fields = wire.decode_message(data)
    assert same(fields["value"], value)


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal with equal types; NaN equals NaN."""
    if type(one) is not type(other):
        return False
    if isinstance(one, float):
        return one.hex() == other.hex()
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    return bool(one == other)


def test_a_message_of_many_values_is_refused_before_it_fills_the_memory(measured: None) -> None:
    """Three bytes of text take 72 bytes of memory; nested lists would evade a limit on the length of one list."""
    data = b"\xdc\x00\x40" + (b"\xdc\x40\x00" + b"\xa2ab" * (1 << 14)) * 64
    with pytest.raises(wire.WireError, match="oversized: more than 458776 values"):
        validation.parse(data)
    assert tracemalloc.get_traced_memory()[1] < 16 * len(data) + (8 << 20)


@pytest.mark.parametrize("value", [b"\0" * (4 << 20), "x" * (4 << 20), [[b"\0" * (4 << 20)]], {"a": list(range(100_000))}])
def test_an_error_message_is_short_and_cheap_however_large_the_value(value: object, measured: None) -> None:
    before = tracemalloc.get_traced_memory()[1]
    assert len(excerpts.show(value)) <= 80
    assert tracemalloc.get_traced_memory()[1] - before < 1 << 20
