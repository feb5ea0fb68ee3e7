"""Ranges beside the fields: every number of every section has one, and a value outside it is refused by name."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any, NamedTuple

import annotated_types as at
import pytest

from icrl_dist.config import run as config
from icrl_dist.config.run import ConfigError, make_run, override, validate
from icrl_dist.stream import schema
from icrl_dist.stream.schema import Remedy

PROBLEM_OF = {"darkroom": "darkroom", "control": "dmc-hopper-hop"}
"""A problem that has the section; any problem has the others."""


class Range(NamedTuple):
    """The range of one field, or of one item of it."""

    section: str
    """Empty for the fields of the run itself."""
    field: str
    bounds: tuple[Any, ...]
    whole: bool
    """Only whole numbers are allowed."""
    item: bool
    """The range of each item of a tuple."""

    @property
    def where(self) -> str:
        return f"{self.section}.{self.field}" if self.section else self.field


def _flat(metadata: typing.Iterable[Any]) -> tuple[Any, ...]:
    found: list[Any] = []
    for one in metadata:
        found += _flat(one) if isinstance(one, at.GroupedMetadata) else [one]
    return tuple(found)


def _ranges(section: str, cls: Any) -> Iterator[Range]:
    """The ranges of a section's fields.  A field or an item without metadata has no bounds."""
    for field, hint in typing.get_type_hints(cls, include_extras=True).items():
        metadata: tuple[Any, ...] = ()
        if typing.get_origin(hint) is typing.Annotated:
            hint, *more = typing.get_args(hint)
            metadata = _flat(more)
        yield Range(section, field, metadata, hint is int, False)
        if typing.get_origin(hint) is tuple:
            (of, *_) = typing.get_args(hint)
            inner = typing.get_args(of) if typing.get_origin(of) is typing.Annotated else (of,)
            yield Range(section, field, _flat(inner[1:]), inner[0] is int, True)


def _sections() -> dict[str, Any]:
    made = {item.name: item.default_factory for item in dataclasses.fields(config.run_type(None))}
    return {name: cls for name, cls in made.items() if dataclasses.is_dataclass(cls)}


SEED = [one for one in _ranges("", config.Run) if one.bounds]
RANGES = SEED + [one for name, cls in _sections().items() for one in _ranges(name, cls) if one.bounds]


def _outside(one: Range) -> list[Any]:
    """A value just outside each bound."""
    step = 1 if one.whole else 0.001
    values: list[Any] = []
    for bound in one.bounds:
        match bound:
            case at.Gt(limit) | at.Lt(limit):
                values.append(limit)
            case at.Ge(int() | float() as limit):
                values.append(limit - step)
            case at.Le(int() | float() as limit):
                values.append(limit + max(step, 0 if one.whole else 0.001 * limit))
            case at.MinLen(length):
                values.append((0.1,) * (length - 1))
    return [float(value) if not one.whole and not isinstance(value, tuple) else value for value in values]


def _inside(one: Range) -> list[Any]:
    """A value on each bound that belongs to the range, or just inside of it."""
    step = 1 if one.whole else 0.001
    values: list[Any] = []
    for bound in one.bounds:
        match bound:
            case at.Gt(int() | float() as limit):
                values.append(limit + step)
            case at.Lt(int() | float() as limit):
                values.append(limit - step)
            case at.Ge(limit) | at.Le(limit):
                values.append(limit)
    return [value if one.whole else float(value) for value in values]


CASES = [pytest.param(one, value, id=f"{one.where}={value}") for one in RANGES for value in _outside(one)]
EDGES = [pytest.param(one, value, id=f"{one.where}={value}") for one in RANGES for value in _inside(one)]


def test_every_number_of_every_section_has_a_range() -> None:
    assert [one.field for one in SEED] == ["seed"]
    for name, cls in _sections().items():
        hints = typing.get_type_hints(cls)
        for one in _ranges(name, cls):
            hint = hints[one.field]
            if typing.get_origin(hint) is tuple and not one.item:
                continue
            of = typing.get_args(hint)[0] if one.item else hint
            if of in (int, float) or float in typing.get_args(of):
                assert any(isinstance(bound, (at.Gt, at.Ge)) for bound in one.bounds), f"{one.where} has no lower bound"
                assert any(isinstance(bound, (at.Lt, at.Le)) for bound in one.bounds), f"{one.where} has no upper bound"
                assert any(isinstance(bound, Remedy) for bound in one.bounds), f"{one.where} has no remedy"
    assert {one.section for one in RANGES} == {"", *_sections()}, "each section has a range"


@pytest.mark.parametrize(("one", "value"), CASES)
def test_a_value_outside_its_range_is_refused_by_name_with_the_remedy(one: Range, value: Any) -> None:
    run = make_run(PROBLEM_OF.get(one.section, "darkroom"))
    setting = (value,) if one.item else value
    remedy = next(bound.text for bound in one.bounds if isinstance(bound, Remedy))
    expected = f"x: {one.where} = {value!r}: {remedy}"
    written = list(setting) if isinstance(setting, tuple) else setting
    with pytest.raises(ConfigError) as caught:
        override(run, [f"{one.where}={written}"], "x")
    assert str(caught.value) == expected
    changed: dict[str, Any] = {one.field: setting}
    if one.section:
        changed = {one.section: dataclasses.replace(run.section(one.section), **changed)}
    with pytest.raises(ConfigError) as caught:
        validate(dataclasses.replace(run, **changed), "x")
    assert str(caught.value) == expected


@pytest.mark.parametrize(("one", "value"), EDGES)
def test_a_value_on_the_edge_of_its_range_is_read(one: Range, value: Any) -> None:
    read: Any = schema.read(_sections().get(one.section, config.Run), {one.field: [value] if one.item else value}, "x")
    assert getattr(read, one.field) == ((value,) if one.item else value)


@pytest.mark.parametrize(
    ("setting", "range_named"),
    [
        ("seed=9223372036854775808", "0 to 2^63 - 1"),
        ("darkroom.split_seed=9223372036854775808", "0 to 2^63 - 1"),
        ("optim.learning_rate=1e300", "above 0 and at most 1e6"),
        ("icaa.learning_rate=1e300", "above 0 and at most 1e6"),
        ("dagger.learning_rate=1e7", "above 0 and at most 1e6"),
        ("optim.weight_decay=1e300", "from 0 to 1e6"),
        ("stream.lease_s=1e300", "above 0 and at most 1e9"),
        ("pretrain.contexts=2147483648", "above 0 and below 2^31"),
        ("icaa.rounds=9999", "from 0 to 9000"),
        ("icaa.trials=1e300", "expected int"),
    ],
)
def test_numbers_beyond_what_the_machinery_takes_are_refused_with_the_range(setting: str, range_named: str) -> None:
    with pytest.raises(ConfigError) as refused:
        override(make_run(), [setting], "x")
    assert range_named in str(refused.value) and "\n" not in str(refused.value)
