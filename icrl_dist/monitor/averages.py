"""The mean return of one phase over variations, always over the same variations and trials."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icrl_dist.monitor.variations import Pair, PhaseReturns

LAST = 5
"""The last episodes, whose mean is shown."""


def of_newest(
    variations: Iterable[Mapping[Pair, PhaseReturns]], begun: Pair, collecting: Pair | None, limits: tuple[int, int]
) -> list[dict[str, Any]]:
    """The averages of the newest phases, oldest phase first, with their ``name``; see ``of_phase``.

    ``variations``: the phases of each, by (stage, round); ``begun``: the last phase that may have begun; ``collecting``: the
    phase whose returns are arriving; ``limits``: the number of phases, and of returns in a phase, that are kept of one
    variation.  Older phases are left out, because some variations have removed their returns.
    """
    found: dict[Pair, list[PhaseReturns]] = {}
    for phases in variations:
        for key, phase in phases.items():
            if phase.returns and not phase.quarantine:
                found.setdefault(key, []).append(phase)
    newest = sorted(found, key=lambda key: (key <= begun, key))[-limits[0] :]
    answer = []
    for key in sorted(newest):
        pending = 0 if key == collecting else sum(one.pending for one in found[key])
        means = of_phase([(one.returns, one.optimum) for one in found[key]], limits[1], pending)
        answer.append({"name": found[key][0].name, **means})
    return answer


def of_phase(found: Sequence[tuple[Mapping[int, float], float | None]], longest: int, pending: int = 0) -> dict[str, Any]:
    """Mean return by episode over the variations that all have the same episodes.

    ``found``: for each variation its returns by trial (not empty), and its optimum; ``longest``: number of returns that are
    kept of one variation, the newest.  A mean over other variations in each episode would rise and fall with them, so
    the mean ends at one episode, which is chosen so that it is over as many returns as possible, and a variation that
    ends earlier, or that lacks an episode, is left out.  In a finished phase these are all variations.  If an optimum
    above 0 is known, returns are divided by it, and variations without one are left out.  ``pending``: number of
    optima that are still to be computed; until then there is no mean, because it would be over other variations.

    Returns ``scaled`` (whether returns are divided), ``variations`` (number in the mean), ``of`` (number with returns),
    ``pending``, ``trials`` (the last trial in the mean + 1), ``first`` and ``last``: the mean of the first, and of the
    last five, of these episodes (None without a variation).
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
        if not pending and (not scaled or (optimum is not None and optimum > 0))
    ]

    def mean(trials: Sequence[int]) -> float | None:
        values = [returns[trial] / scale for returns, scale in used for trial in trials]
        return round(sum(values) / len(values), 6) if values else None

    return {
        "scaled": scaled,
        "variations": len(used),
        "of": len(found),
        "pending": pending,
        "trials": end + 1,
        "first": mean([begin]),
        "last": mean(range(max(begin, end - LAST + 1), end + 1)),
    }


def _whole(returns: Mapping[int, float], longest: int) -> bool:
    """Whether no episode is missing up to the last, among the ``longest`` newest."""
    last = max(returns)
    return min(returns) == max(0, last - longest + 1) and len(returns) == min(last + 1, longest)
