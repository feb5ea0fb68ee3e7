"""The numbers of ``[evaluate]`` that the suites of an evaluation use where none are given."""

from __future__ import annotations

from typing import Any

from icrl_dist.config.run import Run

DRAWS = 8
"""Sampled adversaries of suite ``attack``."""
ADVERSARIES = 3
"""Trained adversaries of each task in suite ``worst``."""
STEPS = 50_000
"""Steps of the training of each of them."""


def numbers(run: Run, suite: str, given: dict[str, Any]) -> dict[str, Any]:
    """The keys of ``[evaluate]`` that an evaluation of this suite changes; ``given``: those that the user named."""
    if suite == "posterior":
        return {"p": (0.0, 0.2, 0.4, 0.6), "prior": "uniform", "episodes": 40, "seeds": 4} | given
    if suite in ("attack", "worst"):
        return {"p": tuple(one for one in run.evaluate.p if one > 0) or run.evaluate.p} | given
    return given
