"""Which experts earn less than the run asks for: they are named before any label is made of their actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.cache import History
from icrl_dist.interfaces import EndsRun, Problem
from icrl_dist.types import NULL, Variation

_NAMED = 8
"""Experts that a message names."""


class Standing(NamedTuple):
    """What one expert earns, and what the run asks for."""

    name: str
    """Such as ``task3-variation0``."""
    earned: float
    """Mean return of the episodes of its mean action after its training."""
    least: float
    """``sac.least_return`` or ``sac.least_return_disturbed``; 0: nothing is asked for."""

    @property
    def failed(self) -> bool:
        """Whether it earns less."""
        return self.least != 0 and not self.earned >= self.least


def label_of(task: int, number: int) -> str:
    """The name of a variation's expert in messages and files."""
    return f"task{task}-variation{number}"


def least(config: SACConfig, variation: Variation) -> float:
    """The return that an expert of this variation must have; 0: any."""
    return config.least_return if variation.adversary == NULL else config.least_return_disturbed


def earned(history: History) -> float:
    """Mean return of the episodes after the expert's training in which it acts by its mean actions."""
    return float(history.window_rewards.sum(axis=1).mean())


def labels_come_from_experts(problem: Problem) -> bool:
    """Whether experts act after their training and label; else the problem's scripted policy does."""
    return problem.scripted is None


def of(
    rows: Sequence[tuple[int, int]], variations: Sequence[Variation], histories: Sequence[History], config: SACConfig
) -> list[Standing]:
    """The standing of each of these experts; ``rows``: number of the task, and of the variation within it."""
    each = zip(rows, variations, histories, strict=True)
    return [Standing(label_of(*row), earned(history), least(config, variation)) for row, variation, history in each]


def listed(standings: Sequence[Standing]) -> str:
    """How many experts failed, and the names of some, the worst first, as a part of a line; empty if none did."""
    failed = sorted((one for one in standings if one.failed), key=lambda one: one.earned - one.least)
    if not failed:
        return ""
    names = ", ".join(f"{one.name} ({one.earned:.4g} of {one.least:g})" for one in failed[:_NAMED])
    more = f" and {len(failed) - _NAMED} more" if len(failed) > _NAMED else ""
    share = f"{len(failed)} of {len(standings)} experts ({len(failed) / len(standings):.0%})"
    return f"{share} return less than sac.least_return or sac.least_return_disturbed asks for: {names}{more}"


REMEDY = (
    "train them again with more sac.steps or another seed, lower what is asked for, or go on with these by "
    "--sac.failed-experts teach"
)


def require(standings: Sequence[Standing]) -> None:
    """Raises EndsRun with the list and the remedy if an expert failed."""
    if text := listed(standings):
        raise EndsRun(f"{text}: no label was made of them; {REMEDY}")
