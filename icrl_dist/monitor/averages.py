"""The mean return of one phase over variations, always over the same variations and trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

LAST = 5
"""The last episodes, whose mean is shown."""


def of_phase(found: Sequence[tuple[Mapping[int, float], float | None]], longest: int) -> dict[str, Any]:
    """Mean return by episode over the variations that all have the same episodes.

    ``found``: for each variation its returns by trial (not empty), and its optimum; ``longest``: number of returns that are
    kept of one variation, the newest.  A mean over other variations in each episode would rise and fall with them, so
    the mean ends at one episode, which is chosen so that it is over as many returns as possible, and a variation that
    ends earlier, or that lacks an episode, is left out.  In a finished phase these are all variations.  If an optimum
    above 0 is known, returns are divided by it, and variations without one are left out.

    Returns ``scaled`` (whether returns are divided), ``variations`` (number in the mean), ``of`` (number with returns),
    ``trials`` (the last trial in the mean + 1), ``first`` and ``last``: the mean of the first, and of the last five, of
    these episodes (None without a variation).
    """
    scaled = any(optimum is not None and optimum > 0 for _, optimum in found)
    whole = [(max(returns), returns, optimum) for returns, optimum in found if _whole(returns, longest)]
    whole.sort(key=lambda one: -one[0])
    begin = max(0, whole[0][0] - longest + 1) if whole else 0
    counted = [((last - begin + 1) * number, number) for number, (last, _, _) in enumerate(whole, 1)]
    number = max(counted, key=lambda one: (one[0], one[1]))[1] if counted else 0
    end = whole[number - 1][0] if number else -1
    used = [
        (returns, optimum if scaled and optimum else 1.0)
        for _, returns, optimum in whole[:number]
        if not scaled or (optimum is not None and optimum > 0)
    ]

    def mean(trials: Sequence[int]) -> float | None:
        values = [returns[trial] / scale for returns, scale in used for trial in trials]
        return round(sum(values) / len(values), 6) if values else None

    return {
        "scaled": scaled,
        "variations": len(used),
        "of": len(found),
        "trials": end + 1,
        "first": mean([begin]),
        "last": mean(range(max(begin, end - LAST + 1), end + 1)),
    }


def _whole(returns: Mapping[int, float], longest: int) -> bool:
    """Whether no episode is missing up to the last, among the ``longest`` newest."""
    last = max(returns)
    return min(returns) == max(0, last - longest + 1) and len(returns) == min(last + 1, longest)
