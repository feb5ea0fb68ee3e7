"""The section ``[robust]`` of a run file: the training of robust policies against an adversary that learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le

from icrl_dist.config.ranges import Positive, PositiveFloat, Share
from icrl_dist.stream.schema import Remedy

_Shape = Annotated[float, Ge(1), Le(1e6), Remedy("must be from 1 to 1e6; below 1 a Gamma distribution has no finite mode")]


@dataclass(frozen=True)
class RobustConfig:
    """RARL (Pinto et al., 2017) and QARL (Reddi et al., 2024): two SAC players, whose settings are those of ``[sac]``.

    ``sac.steps`` counts the steps in which the protagonist learns; the adversary's steps come on top of them.
    """

    adversary_episodes: Positive = 5
    """Episodes of an iteration in which the adversary learns (QARL's code); they come first."""
    protagonist_episodes: Positive = 5
    """Episodes of an iteration in which the protagonist learns (QARL's code)."""
    bound: Share = 0.7
    """QARL: the curriculum moves while the protagonist's discounted return is at least this share of the undisturbed SAC
    expert's in the same task.  QARL's code has the bound 10, which no discounted return reaches at gamma 0.9."""
    first_concentration: _Shape = 50.0
    """QARL: concentration of the Gamma distribution of the adversary's temperature at the start (QARL's code)."""
    last_concentration: _Shape = 1.0
    """QARL: the concentration that the curriculum moves to (QARL's code)."""
    rate: PositiveFloat = 1000.0
    """QARL: rate of the Gamma distribution; its mean is concentration / rate (QARL's code)."""
    divergence: Annotated[float, Gt(0), Le(1e6), Remedy("must be above 0 and at most 1e6 nats")] = 0.5
    """QARL: largest KL divergence of the new distribution from the former one, in nats (QARL's code)."""
    teacher_episodes: Positive = 30
    """QARL: episodes between two updates of the curriculum (QARL's code)."""
    most_temperature: PositiveFloat = 0.1
    """QARL: drawn temperatures are clipped to 0 and this.  0, the temperature at test, is in the range of training."""
