"""The section ``[darkroom]`` of a run file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt

from icrl_dist.config.ranges import NotNegativeFloat, Seed
from icrl_dist.problems.darkroom.adversaries import Disturbance
from icrl_dist.stream.schema import Remedy


@dataclass(frozen=True)
class DarkRoomConfig:
    """The rooms, their split, and their labels (appendix C.1)."""

    size: Annotated[int, Ge(2), Le(1000), Remedy("a room has 2 to 1000 cells a side")] = 10
    """Side of the square room, in cells."""
    horizon: Annotated[int, Ge(1), Le(10**6), Remedy("an episode has 1 to 1000000 steps")] = 100
    """Steps per episode, H."""
    train_fraction: Annotated[float, Gt(0), Lt(1), Remedy("use a share between 0 and 1")] = 0.8
    """Share of the goals that are training tasks; the other goals are test tasks."""
    split_seed: Seed = 0
    """Seed of the shuffle that splits the goals."""
    gamma: Annotated[float, Gt(0), Le(1), Remedy("a discount lies in (0, 1]")] = 0.99
    """Discount of the optimal action values that labels are computed from."""
    label_slack: NotNegativeFloat = 0.1
    """A label is uniform over the actions whose value is at most this much below the best value."""
    disturbance: Disturbance = "override"
    """What the adversaries of training and test do, each with its own probability p: ``override``: execute an action of
    their own (appendix C.1); ``wind``: displace the agent by one cell after its move, always in the same direction;
    ``permuted``: execute another action for each of the agent's, by one rotation or mirror image of the four moves."""
    labels: Literal["soft", "sampled", "heuristic"] = "soft"
    """``soft``: the distribution that label_slack describes; ``sampled``: one action drawn from it (eq. 1);
    ``heuristic``: the paper's "y first, then x" rule, which is optimal only without disturbance."""
