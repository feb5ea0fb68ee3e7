"""The value of an optional that is there."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def known(value: T | None) -> T:
    """The value.  Raises AssertionError if it is None."""
    assert value is not None
    return value
