"""Checks of what users give to every problem: parameters by name, and generators."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from icrl_dist.arrays import short
from icrl_dist.config.toml import nearest
from icrl_dist.types import Adversary, Task


def check_parameters(owner: Task | Adversary, needed: Sequence[str], optional: Sequence[str] = ()) -> None:
    """Raises ValueError, with the nearest name, for a parameter that the family does not have, and for a missing one.

    Also for a number that is not finite.
    """
    known, given = [*needed, *optional], dict(owner.params)
    for name, value in given.items():
        if name not in known:
            there = f"there are {', '.join(known)}" if known else "it has none"
            raise ValueError(f"{owner.kind}: no parameter {name!r}{nearest(name, known)}; {there}")
        if any(isinstance(one, float) and not math.isfinite(one) for one in (value if isinstance(value, tuple) else (value,))):
            raise ValueError(f"{owner.kind} {name}={value}: expected finite numbers")
    for name in needed:
        if name not in given:
            raise ValueError(f"{owner.kind}: parameter {name!r} is missing; it needs {', '.join(needed)}")


def check_generators(problem: str, batch: int, rngs: Sequence[np.random.Generator]) -> None:
    """Raises ValueError for another number of generators than rows, TypeError for what is no generator."""
    if len(rngs) != batch:
        raise ValueError(f"{problem}: {len(rngs)} generators for {batch} rows")
    for rng in rngs:
        if not isinstance(rng, np.random.Generator):
            raise TypeError(f"{problem}: rngs holds {short(rng)}: expected generators, as from numpy.random.default_rng(seed)")
