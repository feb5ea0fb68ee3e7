"""Strict decoding into annotated dataclasses: every type, every refusal, every range."""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Ge, Gt, Interval, Le, Len, Lt, MaxLen, MinLen, MultipleOf
from hypothesis import given
from hypothesis import strategies as st

from icrl_dist.stream.excerpts import show
from icrl_dist.stream.schema import Infinite, Invalid, Remedy, as_data, check, read

PROBABILITY = "a probability lies in [0, 1]"


@dataclass(frozen=True)
class Inner:
    size: Annotated[int, Ge(2), Remedy("a room has at least 2 cells a side")] = 10
    gamma: Annotated[float, Gt(0), Le(1)] = 0.9


@dataclass(frozen=True)
class Outer:
    seed: Annotated[int, Ge(0)]
    problem: Literal["darkroom", "dmc"] = "darkroom"
    inner: Inner = Inner()
    share: Annotated[float, Interval(ge=0, lt=1)] = 0.5
    p: Annotated[tuple[Annotated[float, Interval(ge=0, le=1), Remedy(PROBABILITY)], ...], MinLen(1)] = (0.0,)
    limit: Annotated[int, Lt(10)] | None = None
    strength: Annotated[float | str, Ge(0)] = 0.0
    name: Annotated[str, Len(1, 8)] = "a"
    flag: bool = False
    pair: tuple[str, int] = ("a", 0)
    anything: Any = None
    steps: Annotated[float, Gt(0), Infinite()] = math.inf
    counts: dict[str, Annotated[int, Ge(0)]] = field(default_factory=dict)
    content: Annotated[bytes, MaxLen(3)] = b""


GOOD: list[tuple[dict[str, Any], str, object]] = [
    ({"seed": 3}, "seed", 3),
    ({"problem": "dmc"}, "problem", "dmc"),
    ({"inner": {}}, "inner", Inner()),
    ({"inner": {"size": 2, "gamma": 1}}, "inner", Inner(2, 1.0)),
    ({"share": 0}, "share", 0.0),
    ({"p": [0, 1]}, "p", (0.0, 1.0)),
    ({"limit": None}, "limit", None),
    ({"limit": 9}, "limit", 9),
    ({"strength": "drop:0.25"}, "strength", "drop:0.25"),
    ({"strength": 2}, "strength", 2.0),
    ({"pair": ["b", 7]}, "pair", ("b", 7)),
    ({"anything": [{"a": None}]}, "anything", [{"a": None}]),
    ({"steps": math.inf}, "steps", math.inf),
    ({"counts": {"a": 1}}, "counts", {"a": 1}),
    ({"content": b"abc"}, "content", b"abc"),
]


@pytest.mark.parametrize(("values", "name", "expected"), GOOD)
def test_values_of_the_right_type_are_decoded(values: dict[str, Any], name: str, expected: object) -> None:
    found = getattr(read(Outer, {"seed": 0, **values}), name)
    assert found == expected and type(found) is type(expected)


BAD: list[tuple[object, str]] = [
    ({"seed": -1}, "seed = -1: must be at least 0"),
    ({"seed": True}, "seed = True: expected int, got bool"),
    ({"seed": 1.0}, "seed = 1.0: expected int, got float"),
    ({"problem": "dmx"}, "problem = 'dmx': choose one of 'darkroom', 'dmc'"),
    ({"problem": []}, "problem = []: choose one of 'darkroom', 'dmc'"),
    ({"inner": 3}, "inner = 3: expected a table [inner]"),
    ({"inner": {"size": 1}}, "inner.size = 1: a room has at least 2 cells a side"),
    ({"inner": {"siez": 1}}, "unknown key inner.siez; did you mean 'size'?; known keys here: size, gamma"),
    ({"inner": {"gamma": 0}}, "inner.gamma = 0.0: must be above 0 and at most 1"),
    ({"share": 1}, "share = 1.0: must be at least 0 and below 1"),
    ({"share": math.nan}, "share = nan: must be finite"),
    ({"share": -math.inf}, "share = -inf: must be finite"),
    ({"share": 10**400}, "must be finite"),
    ({"share": True}, "share = True: expected float, got bool"),
    ({"steps": math.nan}, "steps = nan: must be a number"),
    ({"p": 0.5}, "p = 0.5: expected a list"),
    ({"p": []}, "p = (): must have a length of at least 1"),
    ({"p": [0.5, 1.5]}, f"p = 1.5: {PROBABILITY}"),
    ({"p": ["a"]}, "p = 'a': expected float, got str"),
    ({"limit": 10}, "limit = 10: must be below 10"),
    ({"limit": "a"}, "limit = 'a': expected int, got str"),
    ({"strength": True}, "strength = True: expected float or str, got bool"),
    ({"strength": None}, "strength = None: expected float or str, got NoneType"),
    ({"strength": -1}, "strength = -1.0: must be at least 0"),
    ({"name": ""}, "name = '': must have a length of at least 1 and at most 8"),
    ({"name": b"a"}, "name = b'a': expected str, got bytes"),
    ({"flag": 1}, "flag = 1: expected bool, got int"),
    ({"pair": ["a"]}, "pair = ['a']: expected a list of 2"),
    ({"pair": [1, 1]}, "pair = 1: expected str, got int"),
    ({"counts": {"a": -1}}, "counts = -1: must be at least 0"),
    ({"counts": {1: 1}}, "counts = 1: a key must be text"),
    ({"counts": []}, "counts = []: expected a table [counts]"),
    ({"content": b"abcd"}, "content = b'abcd': must have a length of at most 3"),
    ({3: 1}, "unknown key 3; known keys here: seed,"),
    ({"a\nb": 1}, "unknown key 'a\\nb'; known keys here: seed,"),
    ([], "[]: expected a table"),
]


@pytest.mark.parametrize(("value", "message"), BAD)
def test_everything_else_is_refused_with_place_value_and_remedy(value: object, message: str) -> None:
    with pytest.raises(Invalid) as error:
        read(Outer, {"seed": 0, **value} if isinstance(value, dict) else value)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_missing_key_without_a_default_is_refused() -> None:
    with pytest.raises(Invalid, match="missing key seed; known keys here: seed, problem"):
        read(Outer, {})


def test_the_place_stands_before_every_key() -> None:
    with pytest.raises(Invalid, match=re.escape("run.inner.size = 'a': expected int, got str")):
        read(Outer, {"seed": 0, "inner": {"size": "a"}}, "run")
    with pytest.raises(Invalid, match=re.escape("3: expected a table [run]")):
        read(Outer, 3, "run")


def test_a_message_is_short_however_large_the_value_is() -> None:
    for value in (
        {"seed": "a" * 10_000_000},
        {"a" * 10_000_000: 1},
        {"pair": [[0] * 1_000_000] * 3},
        {"flag": b"\xff" * 1_000_000},
    ):
        with pytest.raises(Invalid) as error:
            read(Outer, {"seed": 0, **value})
        assert len(str(error.value)) < 400
    assert show("short") == "'short'" and len(show(list(range(10_000)))) <= 80


def test_check_repeats_the_ranges_on_an_existing_instance() -> None:
    valid = Outer(seed=1)
    check(valid)
    check(dataclasses.replace(valid, share=0, p=(1,)))
    cases: list[tuple[dict[str, Any], str]] = [
        ({"seed": -1}, "run.seed = -1: must be at least 0"),
        ({"inner": Inner(size=0)}, "run.inner.size = 0: a room has"),
        ({"p": ()}, "run.p = (): must have a length of at least 1"),
        ({"share": "a"}, "run.share = 'a': expected float, got str"),
    ]
    for change, message in cases:
        with pytest.raises(Invalid, match=re.escape(message)):
            check(dataclasses.replace(valid, **change), "run")


@dataclass(frozen=True)
class Checked:
    low: int
    high: int = 0

    def __post_init__(self) -> None:
        check(self)
        if self.low > self.high:
            raise ValueError(f"low = {self.low}: must be at most high")


def test_a_check_between_fields_is_the_class_s_own() -> None:
    assert read(Checked, {"low": 0}) == Checked(0)
    with pytest.raises(Invalid, match="here: low = 1: must be at most high"):
        read(Checked, {"low": 1}, "here")
    with pytest.raises(Invalid, match="low = 'a': expected int, got str"):
        Checked("a")  # type: ignore[arg-type]


@dataclass(frozen=True)
class Unsupported:
    value: list[int]


@dataclass(frozen=True)
class Unchecked:
    value: Annotated[int, MultipleOf(2)]


@pytest.mark.parametrize("cls", [Unsupported, Unchecked])
def test_an_annotation_that_would_not_be_checked_is_an_error(cls: type) -> None:
    with pytest.raises(TypeError):
        read(cls, {"value": []})


_finite = st.floats(allow_nan=False, allow_infinity=False)
_inner = st.builds(Inner, st.integers(2), st.floats(0, 1, exclude_min=True))
_outer = st.builds(
    Outer,
    seed=st.integers(0),
    problem=st.sampled_from(["darkroom", "dmc"]),
    inner=_inner,
    share=st.floats(0, 1, exclude_max=True),
    p=st.lists(st.floats(0, 1), min_size=1).map(tuple),
    limit=st.none() | st.integers(max_value=9),
    strength=st.floats(0, allow_infinity=False) | st.text(),
    name=st.text(min_size=1, max_size=8),
    flag=st.booleans(),
    pair=st.tuples(st.text(), st.integers()),
    anything=st.none() | st.integers() | st.lists(st.text()),
    steps=st.floats(0, exclude_min=True),
    counts=st.dictionaries(st.text(), st.integers(0)),
    content=st.binary(max_size=3),
)


@given(_outer)
def test_plain_data_and_back_is_the_same_instance(instance: Outer) -> None:
    check(instance)
    assert read(Outer, as_data(instance)) == instance


@given(
    _outer,
    st.one_of(
        st.tuples(st.just("seed"), st.integers(max_value=-1)),
        st.tuples(st.just("share"), _finite.filter(lambda x: not 0 <= x < 1)),
        st.tuples(st.just("p"), st.lists(_finite).filter(lambda p: not p or any(not 0 <= x <= 1 for x in p))),
        st.tuples(st.just("limit"), st.integers(10)),
        st.tuples(st.just("name"), st.text(min_size=9) | st.just("")),
        st.tuples(st.just("steps"), st.floats(max_value=0) | st.just(math.nan)),
        st.tuples(st.just("inner"), st.builds(lambda size: {"size": size}, st.integers(max_value=1))),
    ),
)
def test_a_value_out_of_range_is_always_refused(instance: Outer, change: tuple[str, Any]) -> None:
    name, value = change
    with pytest.raises(Invalid):
        read(Outer, {**as_data(instance), name: value})


_data = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(list(as_data(Outer(0)))) | st.text(), inner),
)


@given(_data)
def test_any_plain_data_is_decoded_or_refused_with_invalid(value: object) -> None:
    try:
        found = read(Outer, value)
    except Invalid:
        return
    check(found)
