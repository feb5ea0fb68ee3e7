"""What the faults have in common: reaching their moment, killing a whole run, resuming it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import psutil

from icrl_dist.chaos.schedule import Strike
from icrl_dist.chaos.training import Training, TrainingFailed


@dataclass(frozen=True)
class Struck:
    """The effect of a fault."""

    where: str
    """The run's progress when it struck."""
    landed: bool
    evidence: str
    result: dict[str, Any]
    """The run's ``result.json``."""


class Missed(Exception):  # noqa: N818
    """The strike found nothing to hit; the message says why."""


def reach(training: Training, strike: Strike) -> str:
    """Wait for the moment of a strike; returns the run's progress then.  Raises Missed if the run ended before."""
    where = training.reach(strike)
    if not where:
        raise Missed(f"the run ended before {strike}")
    return where


def learner_of(training: Training) -> psutil.Process:
    """The learner's process.  Raises Missed if it has ended."""
    found = training.learner()
    if found is None:
        raise Missed("the learner had ended")
    return found


def kill_all(training: Training, strike: Strike) -> tuple[str, int]:
    """Start a run and kill all its processes at once; returns its progress then, and their number."""
    training.start()
    where = reach(training, strike)
    count = len(training.tree())
    if left := training.kill():
        raise TrainingFailed(f"{len(left)} processes are alive after SIGKILL, such as {left[0].pid}")
    if training.finished():
        raise Missed("the run had ended")
    return where, count


def resume(training: Training) -> dict[str, Any]:
    """Continue the run of the folder; returns its result."""
    training.start("--resume")
    return training.result()
