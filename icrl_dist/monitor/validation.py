"""Values of a message that nobody vouches for: each is what it should be, or it is odd."""

from __future__ import annotations

import math
from typing import Any

from icrl_dist.types import Identity

_LATEST = 2.5e11
"""Seconds from 1970, either way: what every calendar and clock can show, 7,900 years."""


class InvalidMessageError(Exception):
    """A message to be left out; says why in a word or two."""


def text(value: object, longest: int = 200) -> str:
    """Text, cut to ``longest`` characters, without control characters.  Raises InvalidMessageError for anything else."""
    if type(value) is not str:
        raise InvalidMessageError("schema")
    short = value[:longest]
    return short if short.isprintable() else "".join(c if c.isprintable() else " " for c in short)


def integer(value: object, low: int, high: int = 2**53) -> int:
    """A whole number within bounds.  Raises InvalidMessageError for anything else."""
    if type(value) is not int or not low <= value <= high:
        raise InvalidMessageError("schema")
    return value


def number(value: object) -> float:
    """A finite number.  Raises InvalidMessageError for anything else."""
    if type(value) not in (int, float) or not math.isfinite(value):  # type: ignore[arg-type]
        raise InvalidMessageError("schema")
    return float(value)  # type: ignore[arg-type]


def timestamp(value: object) -> float:
    """A moment, Unix seconds.  Raises InvalidMessageError for anything else, and for one that no clock shows."""
    found = number(value)
    if abs(found) > _LATEST:
        raise InvalidMessageError("schema")
    return found


def bounded_list(value: object, longest: int) -> list[Any]:
    """A list of at most so many entries.  Raises InvalidMessageError for anything else."""
    if type(value) is not list or len(value) > longest:
        raise InvalidMessageError("schema")
    return value


def identity(value: object) -> Identity:
    """``STAGE/ROUND/TASK/VARIATION/TRIAL``.  Raises InvalidMessageError for anything else."""
    try:
        return Identity.parse(text(value, 120))
    except ValueError:
        raise InvalidMessageError("schema") from None


def mapping(value: object) -> dict[str, Any]:
    """A map.  Raises InvalidMessageError for anything else."""
    if type(value) is not dict:
        raise InvalidMessageError("schema")
    return value


def numbers(value: object, longest: int) -> list[float]:
    """A list of at most so many finite numbers.  Raises InvalidMessageError for anything else."""
    return [number(one) for one in bounded_list(value, longest)]


def counts(value: object, longest: int = 64) -> dict[str, int]:
    """A map from short names to counts.  Raises InvalidMessageError for anything else."""
    if type(value) is not dict or len(value) > longest:
        raise InvalidMessageError("schema")
    return {text(name, 40): integer(count, 0) for name, count in value.items()}


def parameters(value: object, longest: int = 32) -> dict[str, Any]:
    """A map from short names to numbers, text or short lists of numbers.  Raises InvalidMessageError for anything else."""
    if type(value) is not dict or len(value) > longest:
        raise InvalidMessageError("schema")
    return {text(name, 40): _parameter(one) for name, one in value.items()}


def _parameter(value: object) -> object:
    if type(value) is list:
        return [number(one) if type(one) is float else integer(one, -(2**53)) for one in bounded_list(value, 64)]
    if type(value) in (int, bool):
        return integer(int(value), -(2**53))  # type: ignore[call-overload]
    return number(value) if type(value) is float else text(value)
