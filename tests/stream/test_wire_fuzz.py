"""Bytes that nobody sent in good faith: a value or a WireError, within the memory that reading may take.

``corpus/`` holds what fuzzing found, and what came closest: ``refused-*`` must be refused by
the reader that it is named after, ``accepted-*`` taken; no other reader may break on it either.
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
from icrl_dist.stream import excerpts, validation, wire

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.bin"))
TARGETS = fuzz.targets()


@pytest.fixture
def measured() -> Iterator[None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: file.stem)
def test_the_corpus(file: Path, measured: None) -> None:
    expected, reader, _ = file.stem.split("-", 2)
    data = file.read_bytes()
    for name, target in TARGETS.items():
        outcome, _, ratio = fuzz.attempt(target, data)
        assert outcome in ("accepted", "rejected") and ratio <= 1, name
        if name == reader:
            assert outcome == {"refused": "rejected", "accepted": "accepted"}[expected]


def test_there_is_a_corpus() -> None:
    assert len(CORPUS) >= 15


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(sorted(TARGETS)), seed=st.integers(0, 2**63))
def test_changed_messages(name: str, seed: int, measured: None) -> None:
    target = TARGETS[name]
    outcome, _, ratio = fuzz.attempt(target, fuzz.mutate(np.random.default_rng(seed), target.valid))
    assert outcome in ("accepted", "rejected") and ratio <= 1


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(sorted(TARGETS)), data=st.binary(max_size=2000))
def test_noise(name: str, data: bytes, measured: None) -> None:
    outcome, _, ratio = fuzz.attempt(TARGETS[name], data)
    assert outcome in ("accepted", "rejected") and ratio <= 1


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20) | st.binary(max_size=20),
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(st.text(max_size=5), inside, max_size=4),
    max_leaves=12,
)


@settings(max_examples=100, deadline=None)
@given(PLAIN)
def test_whatever_can_be_sent_comes_back(value: object) -> None:
    try:
        data = wire.encode_message("any", value=value)
    except wire.WireError as error:
        assert error.reason == "schema"  # nested deeper than 8, or text that is not Unicode
        return
    _, fields = wire.decode_message(data)
    assert same(fields["value"], value)


def same(one: Any, other: Any) -> bool:
    """Equal, of the same types, and not-a-number equal to itself."""
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
    """Three bytes of a short text take 72 of memory; lists within a list hide them from a limit on its length."""
    data = b"\xdc\x00\x40" + (b"\xdc\x40\x00" + b"\xa2ab" * (1 << 14)) * 64
    with pytest.raises(wire.WireError, match="oversized: more than 458776 values"):
        validation.parse(data)
    assert tracemalloc.get_traced_memory()[1] < 16 * len(data) + (8 << 20)


@pytest.mark.parametrize("value", [b"\0" * (4 << 20), "x" * (4 << 20), [[b"\0" * (4 << 20)]], {"a": list(range(100_000))}])
def test_an_error_message_is_short_and_cheap_however_large_the_value(value: object, measured: None) -> None:
    before = tracemalloc.get_traced_memory()[1]
    assert len(excerpts.show(value)) <= 80
    assert tracemalloc.get_traced_memory()[1] - before < 1 << 20
