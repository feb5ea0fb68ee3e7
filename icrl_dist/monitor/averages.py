"""The mean return of one phase over variations, always over the same variations and trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

LAST = 5
"""The last episodes, whose mean is shown."""


def of_phase(found: Sequence[tuple[Mapping[int, float], float | None]], longest: int) -> dict[str, Any]:
    """Mean return by episode over the variations that have every episode of the phase so far.

    ``found``: for each variation its returns by trial (not empty), and its optimum; ``longest``: number of returns that are
    kept of one variation, the newest.  If an optimum above 0 is known, returns are divided by it, and variations
    without one are left out.  A mean over other variations in each episode would rise and fall with them.

    Returns ``scaled`` (whether returns are divided), ``variations`` (number in the mean), ``of`` (number with returns),
    ``trials`` (the last trial + 1), ``first`` and ``last``: the mean of the first, and of the last five, of the kept
    episodes (None without a variation).
    """
    last = max(max(returns) for returns, _ in found)
    begin = max(0, last - longest + 1)
    scaled = any(optimum is not None and optimum > 0 for _, optimum in found)
    used = [
        (returns, optimum if scaled and optimum is not None else 1.0)
        for returns, optimum in found
        if len(returns) == last - begin + 1 and min(returns) == begin and (not scaled or (optimum is not None and optimum > 0))
    ]

    def mean(trials: Sequence[int]) -> float | None:
        values = [returns[trial] / scale for returns, scale in used for trial in trials]
        return round(sum(values) / len(values), 6) if values else None

    return {
        "scaled": scaled,
        "variations": len(used),
        "of": len(found),
        "trials": last + 1,
        "first": mean([begin]),
        "last": mean(range(max(begin, last - LAST + 1), last + 1)),
    }
