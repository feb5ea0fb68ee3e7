"""Checks of single values in untrusted messages: each function returns the value or raises InvalidMessageError."""

from __future__ import annotations

import math
from typing import Any

from icrl_dist.stream.excerpts import plain
from icrl_dist.types import Identity

_LATEST = 2.5e11
"""Largest distance from 1970 in seconds, 7,900 years: the range that calendars and clocks can show."""


class InvalidMessageError(Exception):
    """A message that is ignored; its text is the reason, in a word or two."""


def text(value: object, longest: int = 200) -> str:
    """Text as one printable line of at most ``longest`` characters.  Raises InvalidMessageError otherwise."""
    if type(value) is not str:
        raise InvalidMessageError("schema")
    return plain(value, longest)


def integer(value: object, low: int, high: int = 2**53) -> int:
    """An integer from ``low`` to ``high``.  Raises InvalidMessageError otherwise."""
    if type(value) is not int or not low <= value <= high:
        raise InvalidMessageError("schema")
    return value


def number(value: object) -> float:
    """A finite number.  Raises InvalidMessageError otherwise."""
    if type(value) not in (int, float) or not math.isfinite(value):  # type: ignore[arg-type]
        raise InvalidMessageError("schema")
    return float(value)  # type: ignore[arg-type]


def timestamp(value: object) -> float:
    """A time in Unix seconds, within ``_LATEST`` of 1970.  Raises InvalidMessageError otherwise."""
    found = number(value)
    if abs(found) > _LATEST:
        raise InvalidMessageError("schema")
    return found


def bounded_list(value: object, longest: int) -> list[Any]:
    """A list of at most ``longest`` entries.  Raises InvalidMessageError otherwise."""
    if type(value) is not list or len(value) > longest:
        raise InvalidMessageError("schema")
    return value


def identity(value: object) -> Identity:
    """An identity, ``STAGE/ROUND/TASK/VARIATION/TRIAL``.  Raises InvalidMessageError otherwise."""
    try:
        return Identity.parse(text(value, 120))
    except ValueError:
        raise InvalidMessageError("schema") from None


def mapping(value: object) -> dict[str, Any]:
    """A map.  Raises InvalidMessageError otherwise."""
    if type(value) is not dict:
        raise InvalidMessageError("schema")
    return value


def numbers(value: object, longest: int) -> list[float]:
    """A list of at most ``longest`` finite numbers.  Raises InvalidMessageError otherwise."""
    return [number(one) for one in bounded_list(value, longest)]


def counts(value: object, longest: int = 64) -> dict[str, int]:
    """A map of at most ``longest`` short names to counts.  Raises InvalidMessageError otherwise."""
    if type(value) is not dict or len(value) > longest:
        raise InvalidMessageError("schema")
    return {text(name, 40): integer(count, 0) for name, count in value.items()}


def parameters(value: object, longest: int = 32) -> dict[str, Any]:
    """A map of at most ``longest`` short names to numbers, text or short lists of numbers.

    Raises InvalidMessageError otherwise.
    """
    if type(value) is not dict or len(value) > longest:
        raise InvalidMessageError("schema")
    return {text(name, 40): _parameter(one) for name, one in value.items()}


def _parameter(value: object) -> object:
    if type(value) is list:
        return [number(one) if type(one) is float else integer(one, -(2**53)) for one in bounded_list(value, 64)]
    if type(value) in (int, bool):
        return integer(int(value), -(2**53))  # type: ignore[call-overload]
    return number(value) if type(value) is float else text(value)
