"""The settings of tabular Q-learning, which makes the learning histories of Dark Room."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Self

from annotated_types import Ge, Gt, Le, Lt

from icrl_dist.config.ranges import NotNegativeFloat, Probability
from icrl_dist.stream.schema import Remedy

_Step = Annotated[float, Gt(0), Le(1), Remedy("a learning rate of Q-learning lies in (0, 1]")]


@dataclass(frozen=True)
class QLearning:
    """Tabular Q-learning with epsilon-greedy actions.  Rates change linearly from episode to episode of a history."""

    epsilon: Probability = 0.1
    """Probability of a random action in the first episode."""
    epsilon_end: Probability = 0.0
    """The same in the last episode of a history."""
    step: _Step = 1.0
    """Share of the way that a value moves to its target, in the first episode: alpha."""
    step_end: _Step = 0.2
    """The same in the last episode of a history."""
    discount: Annotated[float, Ge(0), Lt(1), Remedy("a discount of Q-learning lies in [0, 1)")] = 0.9
    """Discount of later rewards."""
    optimism: NotNegativeFloat = 1.0
    """Value of every action in every cell before the first episode.  The value of staying on the goal is
    1 / (1 - discount)."""

    @classmethod
    def of(cls, section: QLearning) -> Self:
        """These settings alone, from a section that has others too."""
        return cls(**{item.name: getattr(section, item.name) for item in fields(cls)})
