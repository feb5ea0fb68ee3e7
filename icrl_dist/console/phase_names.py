"""Names of phases for people, equal in the terminal of ``train`` and in all views.

A phase is named as in identities: ``adapt/1`` is the second round, in which T^1 acts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def round_text(run: Mapping[str, Any]) -> str:
    """``Round 2 of 2 (adapt/1)``, ``Pretraining (pretrain/0), 2 rounds follow``, or empty before the first phase."""
    if "phase" not in run:
        return ""
    name, rounds = f"{run['phase']}/{run['round']}", run.get("rounds", 0)
    if run["phase"] == "pretrain":
        follow = f", {rounds} rounds follow" if rounds > 1 else ", 1 round follows" if rounds else ""
        return f"Pretraining ({name}){follow}"
    return f"Round {run['round'] + 1}{f' of {rounds}' if rounds else ''} ({name})"


def stage_text(run: Mapping[str, Any]) -> str:
    """What the run does in a phase: ``adapt/1: rollouts of T^1``, ``adapt/1: fit T^2``, ``pretrain/0: contexts, D^0``."""
    if "phase" not in run:
        return ""
    name, adapts, number = f"{run['phase']}/{run['round']}", run["phase"] == "adapt", run["round"]
    if run["stage"] == "fit":
        return f"{name}: fit T^{number + 1 if adapts else 0}"
    return f"{name}: rollouts of T^{min(number, run['version'])}" if adapts else f"{name}: contexts, D^0"
