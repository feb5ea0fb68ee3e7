"""Figure 6: ICAG with K = 4, 8 and 16 adversaries for each training task, and equal numbers of contexts."""

from __future__ import annotations

from icrl_dist.results.figures.choices import Choice, references
from icrl_dist.results.figures.four import four
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import MissingError, Study

TITLE = "ICAG with K = 4, 8 and 16"
COUNTS = (4, 8, 16)


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """Panels 6a to 6d, or the one of ``letter``."""
    choices = [choice(study, count) for count in COUNTS]
    missing = [study.run(one.variant or one.style) for one in choices if one.variant is None]
    if len(missing) > 1:  # one K shows nothing about K
        raise MissingError(f"figure 6{letter}", missing)
    return four(study, "6", [*choices, *references()], letter)


def choice(study: Study, count: int) -> Choice:
    """ICAG with K = ``count``; a variant without rows has the name that a sweep gives it."""
    variant = study.variant("icag", count)
    free = not any(key.variant == "icag" for key in study.keys)
    style = "icag" if variant or (count == 8 and free) else f"icag-k{count}"
    return Choice(style, variant, f"ICAG, K = {count}")
