"""Figure 3: all methods offline, online, against p, and with unseen priors."""

from __future__ import annotations

from icrl_dist.results.figures.choices import methods, references
from icrl_dist.results.figures.four import four
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import Study

TITLE = "All methods on held-out tasks"
NEEDED = ("dpt", "prompt_dt", "icag", "icaa")


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """Panels 3a to 3d, or the one of ``letter``."""
    return four(study, "3", [*methods(study, NEEDED, ("mix_dpt", "ardt", "ad", "dr")), *references()], letter)
