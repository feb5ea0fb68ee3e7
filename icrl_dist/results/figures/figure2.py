"""Figure 2: the return that each method loses under p = 0.2."""

from __future__ import annotations

from icrl_dist.results.figures import panels
from icrl_dist.results.figures.choices import Spot, entries, methods, references
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import Study
from icrl_dist.results.returns import LAST

TITLE = "Return lost under p = 0.2"
P = 0.2
NEEDED = ("dpt", "prompt_dt", "mix_dpt", "icag", "icaa")


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """One panel: for each method the return at p = 0, at p = 0.2, and the difference in pairs."""
    choices = [*methods(study, NEEDED, ("ardt", "ad", "dr")), *references(("exact:dpt", "exact:icag", "exact:paper", "oracle"))]
    shown, note = entries(study, "figure 2", choices, [Spot(0.0), Spot(P)])
    arms = [arm for entry in shown for arm in entry.arms]
    last = min(LAST, arms[0].returns.shape[3])
    caption = f"Error bars: of the loss, in pairs. {panels.resampled(arms, last)}"
    panel = Panel("2", f"last {last} episodes, uniform adversary", "lost", "", "return", panels.lost(shown, last), caption)
    return [panels.with_note(panel, note)]
