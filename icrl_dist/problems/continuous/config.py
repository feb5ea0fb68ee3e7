"""The section ``[control]`` of a run file, for DeepMind Control and Meta-World."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Interval, Le

from icrl_dist.config.ranges import NotNegative, Positive, Seed
from icrl_dist.stream.schema import Remedy


@dataclass(frozen=True)
class ControlConfig:
    """Tasks, adversaries and contexts of the continuous problems (appendices C.2, C.3)."""

    split_seed: Seed = 0
    """Seed of the split into training and test tasks."""
    train_tasks: Positive = 16
    """m, number of training tasks.  DeepMind Control: the central 2x2, 4x4 or 6x6 of the 8x8 grid of
    physical parameters (m = 16 in appendix C.3); Meta-World: the first tasks of ML1 (15 in appendix C.2)."""
    test_tasks: Positive = 5
    """Number of test tasks: other tasks of the grid, or the next tasks of ML1."""
    horizon: NotNegative = 0
    """Steps per episode; 0: the problem's default, 200 in DeepMind Control, 500 in Meta-World."""
    strength: Annotated[float | str, Ge(0), Le(1e6), Remedy("must be from 0 to 1e6")] = 1.0
    """Strength of a training adversary: 1 is the largest force of ``forces``, or the full ``disturbance``.
    ``drop:0.25``: the smallest strength at which experts that were trained undisturbed lose a quarter of
    their return, as ``icrl-dist bench disturbance --drop`` measured it."""
    histories: Literal["sac", "scripted"] = "sac"
    """Source of contexts.  ``sac``: episodes of the trainings of SAC experts (appendix C.2); ``scripted``
    (Meta-World): episodes of the scripted policy with noise, given right and wrong goals."""
    solved: str = ""
    """The strength of ``drop:SHARE``, as PROBLEM/FORCES/drop:SHARE=STRENGTH.  Stored when the run file is
    read; do not set it."""
    forces: Literal["paper", "qarl"] = "paper"
    """DeepMind Control: the bodies and the size of the adversary's forces, from Table 2 or from QARL's code."""
    disturbance: Annotated[float, Interval(ge=0, le=0.1), Remedy("use 0 to 0.1 meters")] = 0.01
    """Meta-World: meters by which an adversary of strength 1 moves a component of the observation."""
