"""The four panels that figures 3 and 6 share: offline, online without disturbance, against p, and online with unseen priors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from icrl_dist.results.figures import panels
from icrl_dist.results.figures.choices import Choice, Spot, entries, run_of
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import MissingError, Study
from icrl_dist.results.returns import LAST

UNSEEN_P = 0.2
"""Strength of the adversaries with unseen priors."""


def offline(study: Study, name: str, choices: Sequence[Choice]) -> list[Panel]:
    """The return of one episode, given random or expert data (Algorithm 1, lines 3 to 7)."""
    levels = [level for c in choices if c.variant for level in study.levels(c.variant, suite="offline")]
    p = min(levels, default=0.0)
    spots = [Spot(p, suite="offline", data=data, group=f"{data} data") for data in ("random", "expert")]
    shown, note = entries(study, f"figure {name}", choices, spots)
    caption = panels.resampled([arm for entry in shown for arm in entry.arms], 1)
    title = "offline: one episode, given data" + (f", p = {p:g}" if p else "")
    return [panels.with_note(Panel(name, title, "bars", "", "return", panels.bars(shown, 1), caption), note)]


def online(study: Study, name: str, choices: Sequence[Choice], p: float = 0.0, prior: str = "uniform") -> list[Panel]:
    """The return of each online episode at one p."""
    shown, note = entries(study, f"figure {name}", choices, [Spot(p, prior)])
    caption = panels.resampled([entry.arms[0] for entry in shown], 1)
    title = "online, no disturbance" if p == 0 else f"online, {prior} priors, p = {p:g}"
    panel = Panel(name, title, "lines", "online episode", "return", panels.by_episode(shown), caption)
    return [panels.with_note(panel, note)]


def against_p(study: Study, name: str, choices: Sequence[Choice], title: str = "uniform adversary") -> list[Panel]:
    """The return against p: of the last episodes, and the mean over all episodes."""
    several = [levels for c in choices if c.variant and len(levels := study.levels(c.variant)) > 1]
    levels = several[0] if several else []
    if not levels:
        places = [Spot(p) for p in (0.0, 0.2, 0.4, 0.6)]
        raise MissingError(f"figure {name}", [run_of(study, choice, places) for choice in choices if choice.needed])
    shown, note = entries(study, f"figure {name}", choices, [Spot(p) for p in levels])
    arms = [arm for entry in shown for arm in entry.arms]
    episodes = arms[0].returns.shape[3]
    found: list[Panel] = []
    for suffix, last, text in (
        ("", min(LAST, episodes), f"last {min(LAST, episodes)}"),
        (" (all)", episodes, f"all {episodes}"),
    ):
        series, caption = panels.against_p(shown, last), panels.resampled(arms, last)
        panel = Panel(f"{name}{suffix}", f"{title}, {text} episodes", "lines", "p", "return", series, caption)
        found.append(panels.with_note(panel, note))
    return found


def four(study: Study, number: str, choices: Sequence[Choice], letter: str = "") -> list[Panel]:
    """Panels a to d of a figure, or the one of ``letter``."""
    makers: dict[str, Callable[[], list[Panel]]] = {
        "a": lambda: offline(study, f"{number}a", choices),
        "b": lambda: online(study, f"{number}b", choices),
        "c": lambda: against_p(study, f"{number}c", choices),
        "d": lambda: online(study, f"{number}d", choices, UNSEEN_P, "unseen"),
    }
    return allowed(study, [make for key, make in makers.items() if letter in ("", key)])


def allowed(study: Study, makers: Sequence[Callable[[], list[Panel]]]) -> list[Panel]:
    """The panels of all makers; with ``rules.partial`` without those whose rows are missing, which the last caption names."""
    found: list[Panel] = []
    missing: list[MissingError] = []
    for make in makers:
        try:
            found += make()
        except MissingError as error:
            missing.append(error)
    if missing and (not found or not study.rules.partial):
        raise MissingError(str(missing[0]).split(":")[0], [run for error in missing for run in error.runs])
    notes = ". ".join(f"Left out: {error}" for error in missing)
    return [*found[:-1], panels.with_note(found[-1], notes)]
