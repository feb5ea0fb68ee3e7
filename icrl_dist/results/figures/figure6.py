"""Figure 6: ICAG with K = 4, 8 and 16 adversaries for each training task, and equal numbers of contexts."""

from __future__ import annotations

from icrl_dist.results.figures.choices import Choice, references
from icrl_dist.results.figures.four import four
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import Study

TITLE = "ICAG with K = 4, 8 and 16"
COUNTS = (4, 8, 16)


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """Panels 6a to 6d, or the one of ``letter``."""
    return four(study, "6", [*(choice(study, count) for count in COUNTS), *references()], letter)


def choice(study: Study, count: int) -> Choice:
    """ICAG with K = ``count``; a variant without rows has the name that a sweep gives it."""
    variant = study.variant("icag", count)
    style = "icag" if variant or count == 8 else f"icag-k{count}"
    return Choice(style, variant, f"ICAG, K = {count}")
