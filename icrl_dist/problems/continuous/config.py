"""The section ``[control]`` of a run file, which DeepMind Control and Meta-World share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Interval

from icrl_dist.config.ranges import NotNegative, Positive, Seed
from icrl_dist.stream.schema import Remedy


@dataclass(frozen=True)
class ControlConfig:
    """The continuous games (appendix C.2, C.3); without effect in Dark Room."""

    split_seed: Seed = 0
    """Seed of the split into training and test tasks."""
    train_tasks: Positive = 16
    """m, tasks that are trained on.  DeepMind Control: the central 2x2, 4x4 or 6x6 of the 8x8 grid of
    physical parameters (m = 16 in appendix C.3); Meta-World: the first of ML1's (15 in appendix C.2)."""
    test_tasks: Positive = 5
    """Tasks that are only tested: others of the grid, or ML1's next."""
    horizon: NotNegative = 0
    """Steps an episode; 0: the problem's own, 200 in DeepMind Control, 500 in Meta-World."""
    strength: Annotated[float | str, Ge(0), Remedy("must not be negative, and be finite")] = 1.0
    """Strength of a pretraining adversary: 1 is Table 2's largest force, or the full ``disturbance``.
    ``drop:0.25``: the smallest at which the undisturbed experts lose a quarter of their return, as
    ``icrl-dist bench disturbance --drop`` has measured it."""
    histories: Literal["sac", "scripted"] = "sac"
    """What contexts are: episodes of SAC experts' trainings (appendix C.2), or, in Meta-World, of the
    scripted policy, told the right goal and wrong ones by turns, with noise
    (``problems.metaworld.scripted_contexts``)."""
    solved: str = ""
    """What a drop came to when the run was read, as PROBLEM/FORCES/drop:SHARE=STRENGTH; not for you to set."""
    forces: Literal["paper", "qarl"] = "paper"
    """DeepMind Control: where and how hard an adversary pushes, by Table 2 or by QARL's code."""
    disturbance: Annotated[float, Interval(ge=0, le=0.1), Remedy("0 to 0.1 metres")] = 0.01
    """Meta-World: metres that an adversary of strength 1 moves a component of what is observed."""
