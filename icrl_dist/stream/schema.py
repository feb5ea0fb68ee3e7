"""Strict decoding of plain data (what TOML or msgpack gives) into annotated dataclasses, ranges included.

A field states its type and its range in one place::

    @dataclass(frozen=True)
    class Room:
        size: Annotated[int, Ge(2), Remedy("a room has at least 2 cells a side")] = 10

``read`` decodes, ``as_data`` is its inverse, ``check`` repeats the range checks on an existing
instance.  Types: bool, int, float, str, bytes, Literal, unions of these, ``X | None``, tuples,
``dict[str, T]``, nested dataclasses (not recursive ones) and Any.  Ranges are those of
``annotated_types``: Gt, Ge, Lt, Le, Interval, MinLen, MaxLen, Len, and Predicate together with a Remedy.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn, TypeVar, Union

import annotated_types as at

from icrl_dist.stream.excerpts import LONGEST, nearest, show

_T = TypeVar("_T")
_Reader = Callable[[Any, str], Any]
"""Takes a value and its place; returns the decoded value or raises Invalid."""


class Invalid(ValueError):  # noqa: N818
    """A value that is not allowed; the message holds its place, the value and the remedy in one line."""


@dataclass(frozen=True)
class Remedy:
    """Metadata of an annotation: the text that an out-of-range value is refused with."""

    text: str


@dataclass(frozen=True)
class Infinite:
    """Metadata of an annotation: a float may be infinite.  NaN is always refused."""


def read(cls: type[_T], value: object, where: str = "") -> _T:
    """``value``, a map of plain data, as an instance of the dataclass ``cls``.

    ``where`` is the place that error messages name.  Raises Invalid for an unknown or missing
    key, a wrong type and a value out of range.
    """
    return _build(cls, value, where)


def check(instance: Any, where: str = "") -> None:
    """Check types and ranges of an existing instance.  Raises Invalid as ``read`` does."""
    _decode(type(instance), as_data(instance), where)


def as_data(instance: Any) -> dict[str, Any]:
    """The fields of a dataclass instance as plain data; tuples become lists."""
    cls: Any = type(instance)  # mypy counts no class of instances as hashable
    return {name: _as_data(getattr(instance, name)) for name in _fields(cls)}


@dataclass(frozen=True, slots=True)
class _Field:
    read: _Reader
    required: bool


@functools.cache
def _fields(cls: Any) -> dict[str, _Field]:
    hints = typing.get_type_hints(cls, include_extras=True)
    missing = dataclasses.MISSING
    return {
        field.name: _Field(_reader(hints[field.name]), field.default is missing and field.default_factory is missing)
        for field in dataclasses.fields(cls)
        if field.init
    }


def _build(cls: type[_T], value: object, where: str) -> _T:
    values = _decode(cls, value, where)
    try:
        return cls(**values)
    except Invalid:
        raise
    except ValueError as error:  # from the class's own __post_init__
        raise Invalid(f"{where}: {error}" if where else str(error)) from error


def _decode(cls: type, value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        _refuse(value, where, f"expected a table [{where}]" if where else "expected a table")
    fields, prefix = _fields(cls), f"{where}." if where else ""
    values = {}
    for name, item in value.items():
        field = fields.get(name)
        if field is None:
            text = name if isinstance(name, str) and name.isprintable() and len(name) <= LONGEST else show(name)
            known = f"known keys here: {', '.join(fields)}"
            raise Invalid(f"unknown key {prefix}{text}{nearest(text, list(fields))}; {known}")
        values[name] = field.read(item, prefix + name)
    if len(values) < len(fields):
        for name, field in fields.items():
            if field.required and name not in values:
                raise Invalid(f"missing key {prefix}{name}; known keys here: {', '.join(fields)}")
    return values


def _as_data(value: object) -> Any:
    if isinstance(value, (tuple, list)):
        return [_as_data(item) for item in value]
    if isinstance(value, dict):
        return {name: _as_data(item) for name, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return as_data(value)
    return value


def _refuse(value: object, where: str, remedy: str) -> NoReturn:
    raise Invalid(f"{where} = {show(value)}: {remedy}" if where else f"{show(value)}: {remedy}")


def _reader(hint: Any, metadata: Sequence[object] = ()) -> _Reader:
    """The function that decodes a value of this type; each class builds it once."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _reader(args[0], [*metadata, *args[1:]])
    infinite = any(isinstance(item, Infinite) for item in metadata)
    return _ranged(_plain_reader(hint, origin, args, infinite), metadata)


def _plain_reader(hint: Any, origin: Any, args: tuple[Any, ...], infinite: bool) -> _Reader:
    if hint is Any:
        return lambda value, where: value
    if dataclasses.is_dataclass(hint):
        _fields(typing.cast(Any, hint))  # an unsupported type is refused now and not at the first value
        return functools.partial(_build, typing.cast(type, hint))
    if origin is Literal:
        return _literal(args)
    if origin is tuple:
        return _tuple(args)
    if origin is dict and args[0] is str:
        return _dict(_reader(args[1]))
    if origin in (Union, types.UnionType):
        return _union(args, infinite)
    if hint is float:
        return _float(infinite)
    if hint in (bool, int, str, bytes):
        return _exact(hint)
    raise TypeError(f"{hint!r}: a field of this type cannot be decoded")


def _exact(kind: type) -> _Reader:
    def read(value: Any, where: str) -> Any:
        if type(value) is not kind:
            _refuse(value, where, f"expected {kind.__name__}, got {type(value).__name__}")
        return value

    return read


def _float(infinite: bool) -> _Reader:
    def read(value: Any, where: str) -> float:
        if type(value) is int:
            try:
                return float(value)
            except OverflowError:
                _refuse(value, where, "must be finite")
        if type(value) is not float:
            _refuse(value, where, f"expected float, got {type(value).__name__}")
        if value != value or (not infinite and math.isinf(value)):
            _refuse(value, where, "must be a number" if infinite else "must be finite")
        return value

    return read


def _literal(choices: tuple[Any, ...]) -> _Reader:
    known = {(type(choice), choice) for choice in choices}  # True is no 1
    kinds = {type(choice) for choice in choices}

    def read(value: Any, where: str) -> Any:
        if type(value) not in kinds or (type(value), value) not in known:
            _refuse(value, where, f"choose one of {', '.join(map(repr, choices))}")
        return value

    return read


def _tuple(args: tuple[Any, ...]) -> _Reader:
    if len(args) == 2 and args[1] is ...:
        every = _reader(args[0])

        def read_any(value: Any, where: str) -> Any:
            if type(value) not in (list, tuple):
                _refuse(value, where, "expected a list")
            return tuple([every(item, where) for item in value])

        return read_any
    readers = [_reader(arg) for arg in args]

    def read_fixed(value: Any, where: str) -> Any:
        if type(value) not in (list, tuple) or len(value) != len(readers):
            _refuse(value, where, f"expected a list of {len(readers)}")
        return tuple([read(item, where) for read, item in zip(readers, value, strict=True)])

    return read_fixed


def _dict(every: _Reader) -> _Reader:
    def read(value: Any, where: str) -> Any:
        if type(value) is not dict:
            _refuse(value, where, f"expected a table [{where}]")
        for name in value:
            if type(name) is not str:
                _refuse(name, where, "a key must be text")
        return {name: every(item, where) for name, item in value.items()}

    return read


def _union(args: tuple[Any, ...], infinite: bool) -> _Reader:
    """The member that has the value's type; with a float member, an int is a float unless int is a member too."""
    optional = types.NoneType in args
    members = [arg for arg in args if arg is not types.NoneType]
    readers: dict[type, _Reader] = {}
    for member in members:
        read_member = _reader(member, [Infinite()] if infinite else [])
        for kind in _data_types(member):
            readers.setdefault(kind, read_member)
    if float in readers:
        readers.setdefault(int, readers[float])
    names = " or ".join(getattr(member, "__name__", str(member)) for member in members)
    only = _reader(members[0], [Infinite()] if infinite else []) if len(members) == 1 else None

    def read(value: Any, where: str) -> Any:
        if value is None and optional:
            return None
        found = only or readers.get(type(value))
        if found is None:
            _refuse(value, where, f"expected {names}, got {type(value).__name__}")
        return found(value, where)

    return read


def _data_types(hint: Any) -> Iterable[type]:
    """The types of plain data that a union member of this type is decoded from."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _data_types(args[0])
    if origin is Literal:
        return [type(choice) for choice in args]
    if origin is tuple:
        return [list, tuple]
    if origin is dict or dataclasses.is_dataclass(hint):
        return [dict]
    return [hint]


_BOUNDS: dict[type, tuple[str, Callable[[Any, Any], bool], str]] = {
    at.Gt: ("gt", operator.gt, "above {}"),
    at.Ge: ("ge", operator.ge, "at least {}"),
    at.Lt: ("lt", operator.lt, "below {}"),
    at.Le: ("le", operator.le, "at most {}"),
}
_LENGTHS: dict[type, tuple[str, Callable[[Any, Any], bool], str]] = {
    at.MinLen: ("min_length", operator.ge, "at least {}"),
    at.MaxLen: ("max_length", operator.le, "at most {}"),
}


def _ranged(inner: _Reader, metadata: Sequence[object]) -> _Reader:
    """``inner`` with the ranges of an annotation; values without an order (None, text) skip numeric bounds."""
    bounds, lengths, predicates, text = [], [], [], ""
    for item in _ungrouped(metadata):
        if isinstance(item, Remedy):
            text = item.text
        elif type(item) in _BOUNDS:
            name, holds, words = _BOUNDS[type(item)]
            bounds.append((holds, getattr(item, name), words))
        elif type(item) in _LENGTHS:
            name, holds, words = _LENGTHS[type(item)]
            lengths.append((holds, getattr(item, name), words))
        elif isinstance(item, at.Predicate):
            predicates.append(item.func)
        elif isinstance(item, at.BaseMetadata):
            raise TypeError(f"{item!r}: a range of this kind is not checked")
    if not bounds and not lengths and not predicates:
        return inner
    checks = [(holds, bound) for holds, bound, _ in bounds]
    remedy = text or "must be " + " and ".join(words.format(bound) for _, bound, words in bounds)
    remedy_length = text or "must have a length of " + " and ".join(words.format(bound) for _, bound, words in lengths)

    def read(value: Any, where: str) -> Any:
        found = inner(value, where)
        if checks and isinstance(found, (int, float)):
            for holds, bound in checks:
                if not holds(found, bound):
                    _refuse(found, where, remedy)
        if lengths and hasattr(found, "__len__"):
            for holds, bound, _ in lengths:
                if not holds(len(found), bound):
                    _refuse(found, where, remedy_length)
        if not all(holds(found) for holds in predicates):
            _refuse(found, where, text)
        return found

    return read


def _ungrouped(metadata: Sequence[object]) -> Iterable[object]:
    for item in metadata:
        if isinstance(item, at.GroupedMetadata):
            yield from _ungrouped(list(item))
        else:
            yield item
