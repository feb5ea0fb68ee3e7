"""Return against strength in the settings in which the disturbance must be inferred."""

from __future__ import annotations

from icrl_dist.results.figures.choices import methods, references
from icrl_dist.results.figures.four import against_p
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import Study

TITLE = "Return against strength where the disturbance must be inferred"
NEEDED = ("dpt", "icag", "icaa")


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """Two panels of one setting: the last episodes, and all."""
    choices = [*methods(study, NEEDED, ("prompt_dt", "mix_dpt", "ardt", "ad", "dr")), *references()]
    return against_p(study, f"strength, {study.setting}", choices, study.setting)
