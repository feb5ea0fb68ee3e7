"""Figure 7: ICAA after each round beside ICAG."""

from __future__ import annotations

from icrl_dist.results.figures.choices import Choice, references
from icrl_dist.results.figures.four import against_p, allowed, online
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import MissingError, Study

TITLE = "ICAA after each round, and ICAG"


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """Panels 7a (online at p = 0) and 7b (against p), or the one of ``letter``."""
    variant = study.variant("icaa")
    versions = study.versions(variant) if variant else []
    if len(versions) < 2:
        raise MissingError("figure 7", [f"{study.run(variant or 'icaa')}, evaluated after each round"])
    # From the newest to T^0, so that the newest has the full colour.
    rounds = [Choice("icaa", variant, f"ICAA, T^{version}", version) for version in reversed(versions)]
    choices = [Choice("icag", study.variant("icag")), *rounds, *references()]
    makers = {"a": lambda: online(study, "7a", choices), "b": lambda: against_p(study, "7b", choices)}
    return allowed(study, [make for key, make in makers.items() if letter in ("", key)])
