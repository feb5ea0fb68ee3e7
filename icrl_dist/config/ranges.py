"""Number types with ranges, for the fields of a run file's sections."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Interval, Lt

from icrl_dist.stream.schema import Remedy

_ABOVE_0 = Remedy("must be above 0 and finite")
_NOT_NEGATIVE = Remedy("must not be negative, and be finite")

Positive = Annotated[int, Gt(0), Lt(2**63), _ABOVE_0]
"""A whole number above 0."""
PositiveFloat = Annotated[float, Gt(0), _ABOVE_0]
"""A number above 0."""
NotNegative = Annotated[int, Ge(0), Lt(2**63), _NOT_NEGATIVE]
"""A whole number, 0 or more."""
NotNegativeFloat = Annotated[float, Ge(0), _NOT_NEGATIVE]
"""A number, 0 or more."""
Probability = Annotated[float, Interval(ge=0, le=1), Remedy("a probability lies in [0, 1]")]
"""A probability."""
Share = Annotated[float, Interval(ge=0, le=1), Remedy("a share lies in [0, 1]")]
"""A share of a whole."""
Seed = Annotated[int, Ge(0), Lt(2**63), Remedy("a seed is a whole number from 0 to 2^63 - 1")]
"""A seed of random numbers."""


def remedy(low: int, high: int | None, reason: str) -> str:
    """The remedy for a number whose range depends on other settings: ``use LOW to HIGH: REASON``; None: no upper bound.

    Raises ValueError for an empty range: then the number has no remedy, and the message must name another setting.
    """
    if high is not None and high < low:
        raise ValueError(f"the range {low} to {high} is empty")
    span = f"at least {low}" if high is None else f"{low} to {high}" if low < high else f"{low}"
    return f"use {span}: {reason}"
