"""The agents that a figure shows, and their arms at the places that it shows: rows that are missing are named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from icrl_dist.results.figures import styles
from icrl_dist.results.figures.panels import Entry, is_reference
from icrl_dist.results.figures.reading import Arm
from icrl_dist.results.figures.selection import EXACT, REFERENCES, MissingError, Study, of_budget, unequal


class Spot(NamedTuple):
    """A place of a panel: rows of one suite, strength and prior; of suite ``offline`` also whose data the context holds."""

    p: float
    prior: str = "uniform"
    suite: str = "online"
    data: str = ""
    group: str = ""
    """The name of its group of bars."""


class Choice(NamedTuple):
    """An agent of a figure: a policy version of a variant, or a reference agent."""

    style: str
    """A method, or the key of a reference agent."""
    variant: str | None = None
    """None: a reference agent, or a method without rows."""
    name: str = ""
    """What the legend calls it; empty: the label of its style."""
    version: int | None = None
    """None: the newest."""
    rule: str = "paper"
    needed: bool = True
    """Whether the figure is refused without it."""

    @property
    def label(self) -> str:
        return self.name or styles.label_of(self.style)

    def at(self, study: Study, spot: Spot) -> Arm | None:
        """Its arm at a place; None if there are no rows."""
        where = {"prior": spot.prior, "suite": spot.suite}
        if is_reference(self.style):
            found = study.reference(self.style, spot.p, data=spot.data, **where)
            return found or (study.reference(self.style, spot.p, **where) if spot.data else None)
        if self.variant is None:
            return None
        return study.model(self.variant, spot.p, data=spot.data, version=self.version, rule=self.rule, **where)


def methods(study: Study, needed: Sequence[str], others: Sequence[str] = ()) -> list[Choice]:
    """The methods of a figure, those that are needed and those of ``others`` that have rows, in that order."""
    found = [Choice(method, study.variant(method)) for method in needed]
    more = [Choice(method, study.variant(method), needed=False) for method in others]
    return [*found, *(choice for choice in more if choice.variant is not None)]


def references(agents: Sequence[str] = REFERENCES) -> list[Choice]:
    """The reference agents of a figure."""
    return [Choice(agent, needed=False) for agent in agents]


def entries(study: Study, what: str, choices: Sequence[Choice], spots: Sequence[Spot]) -> tuple[list[Entry], str]:
    """The agents that have rows at all places, and a sentence about those that lack them.

    Raises MissingError if an agent that is needed lacks rows, or no method has any (with ``rules.partial`` only then), and
    ConfigError for arms that may not be compared (``Study.comparable``).
    """
    found: list[tuple[Choice, list[Arm]]] = []
    lacking: list[Choice] = []
    absent: dict[Choice, list[Spot]] = {}
    for choice in choices:
        every = [choice.at(study, spot) for spot in spots]
        arms = [arm for arm in every if arm is not None]
        absent[choice] = [spot for spot, arm in zip(spots, every, strict=True) if arm is None]
        if len(arms) == len(spots):
            found.append((choice, arms))
        elif choice.needed or not is_reference(choice.style) or choice.style in REFERENCES:
            lacking.append(choice)
    if any(choice.style == "exact:icag" for choice, _ in found):  # ``exact:paper`` is the exact agent of a run without it
        found = [(choice, arms) for choice, arms in found if choice.style != "exact:paper"]
    needed = [choice for choice in lacking if choice.needed]
    if (needed and not study.rules.partial) or not any(not is_reference(choice.style) for choice, _ in found):
        raise MissingError(what, [run_of(study, choice, absent[choice]) for choice in needed or lacking or choices])
    same = iter(study.comparable([arm for _, arms in found for arm in arms], what))
    groups = [spot.group for spot in spots]
    shown = [Entry(choice.label, choice.style, [next(same) for _ in arms], groups) for choice, arms in found]
    return shown, _note(study, lacking, [entry.arms[0] for entry in shown if not is_reference(entry.style)])


def run_of(study: Study, choice: Choice, absent: Sequence[Spot]) -> str:
    """The runs that make rows of an agent; of runs that have some, also the places that were not evaluated."""
    name = choice.variant or (EXACT if is_reference(choice.style) else choice.style)
    if not any(key.variant == name for key in study.keys):
        return study.run(name)
    places = [
        " ".join(
            part for part in (one.suite, f"p = {one.p:g}", one.prior if one.p else "", one.data and f"{one.data} data") if part
        )
        for one in absent
    ]
    return f"{study.run(name)} (evaluated at {', '.join(places)})" if places else study.run(name)


def _note(study: Study, lacking: Sequence[Choice], models: Sequence[Arm]) -> str:
    without = [choice.label for choice in lacking if not is_reference(choice.style)]
    exact = [choice.label for choice in lacking if is_reference(choice.style) and choice.style not in ("exact:paper", "random")]
    parts = [f"No rows of {', '.join(without)}"] if without else []
    parts += [f"No rows of {', '.join(exact)} (runs {study.run(EXACT)})"] if exact else []
    if study.rules.common_seeds:
        parts.append("Only training seeds that all of these agents have")
    parts += [
        f"Budgets differ: {column} is {of_budget(one, column):,.0f} of {one.key.variant} and {of_budget(two, column):,.0f} of "
        f"{two.key.variant}"
        for column, one, two in unequal(models)
    ]
    return ". ".join(parts)
