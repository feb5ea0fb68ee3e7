"""Number types with ranges, for the fields of a run file's sections."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Interval, Le, Lt

from icrl_dist.stream.schema import Remedy

_MOST, _LARGEST = 2**31 - 1, 1e9
_ABOVE_0 = Remedy("must be above 0 and below 2^31")
_NOT_NEGATIVE = Remedy("must be from 0 to 2^31 - 1")

Positive = Annotated[int, Gt(0), Le(_MOST), _ABOVE_0]
"""A whole number above 0.  Identities of trajectories are stored as numbers below 2^31."""
PositiveFloat = Annotated[float, Gt(0), Le(_LARGEST), Remedy("must be above 0 and at most 1e9")]
"""A number above 0.  Timers and float32 take at most about 1e9 without a loss."""
NotNegative = Annotated[int, Ge(0), Le(_MOST), _NOT_NEGATIVE]
"""A whole number, 0 or more."""
NotNegativeFloat = Annotated[float, Ge(0), Le(_LARGEST), Remedy("must be from 0 to 1e9")]
"""A number, 0 or more."""
Rate = Annotated[float, Gt(0), Le(1e6), Remedy("a rate must be above 0 and at most 1e6")]
"""A learning rate; float32 parameters take no larger steps."""
Rounds = Annotated[int, Ge(0), Le(9000), Remedy("must be from 0 to 9000; the files of versions have four digits")]
"""A number of rounds; each makes a version of the weights."""
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
