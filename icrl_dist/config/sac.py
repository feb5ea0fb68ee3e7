"""The section ``[sac]`` of a run file: the training of SAC experts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen

from icrl_dist.stream.schema import Remedy

_LAYERS = Remedy("must be at least one layer, of 1 to 2^31 - 1 units each")
AboveZero = Annotated[float, Gt(0), Le(1e6), Remedy("must be above 0 and at most 1e6")]
WholeAboveZero = Annotated[int, Gt(0), Le(2**31 - 1), Remedy("must be above 0 and below 2^31")]


@dataclass(frozen=True)
class SACConfig:
    """Training of the SAC experts: Table 1 of the paper, or QARL's code where the table has no value or a misprint."""

    hidden: Annotated[tuple[Annotated[int, Gt(0), Le(2**31 - 1), _LAYERS], ...], MinLen(1), _LAYERS] = (256, 256, 256)
    """Widths of the hidden layers, ReLU, of the actor and of each of the two critics (Table 1)."""
    actor_rate: AboveZero = 1e-4
    """Adam's learning rate for the actor (Table 1)."""
    critic_rate: AboveZero = 3e-4
    """Adam's learning rate for the critics (Table 1)."""
    temperature_rate: AboveZero = 3e-4
    """Adam's learning rate for the logarithm of the temperature (Table 1)."""
    tau: Annotated[float, Gt(0), Le(1), Remedy("must be above 0 and at most 1")] = 0.005
    """Weight of the critics in the moving average of the target critics, per update (Table 1)."""
    gamma: Annotated[float, Ge(0), Lt(1), Remedy("must be in [0, 1)")] = 0.9
    """Discount per step (section 5)."""
    batch: WholeAboveZero = 256
    """Transitions per update (Table 1)."""
    random_steps: Annotated[int, Ge(0), Le(2**31 - 1), Remedy("must be from 0 to 2^31 - 1")] = 3_000
    """Steps of uniformly random actions at the start (Table 1)."""
    warmup: Annotated[int, Ge(1), Le(2**31 - 1), Remedy("must be from 1 to 2^31 - 1")] = 5_000
    """Steps before the first update (Table 1)."""
    replay: WholeAboveZero = 1_000_000
    """Capacity of the replay buffer, in transitions (Table 1)."""
    temperature: AboveZero = 5e-3
    """Initial temperature (QARL's code; Table 1 prints 5*10^3, without the minus sign).  The target entropy
    is -A for A action components."""
    update_every: WholeAboveZero = 3
    """Environment steps per update (QARL's code)."""
    steps: WholeAboveZero = 200_000
    """Environment steps of an expert's training."""
    checkpoints: WholeAboveZero = 1
    """Checkpoints of which the best one acts and labels as the expert: the parameters at the end of a training and at evenly
    spaced earlier episodes of its last fifth.  1: those at the end.  ``checkpoint_episodes`` has no effect then."""
    checkpoint_episodes: WholeAboveZero = 5
    """Episodes of the mean action by which each checkpoint of an expert is evaluated.  All take checkpoints x episodes x
    horizon environment steps more, without updates: 5,000 at 5 x 5 x 200."""
    least_return: Annotated[float, Ge(-1e6), Le(1e6), Remedy("must be from -1e6 to 1e6")] = 0.0
    """Return per episode that an undisturbed expert must reach by its mean action, such as 80% of what a long training
    reaches; 0: any.  Experts that do not are named before labels are made of them, and end the run; see
    ``failed_experts``."""
    least_return_disturbed: Annotated[float, Ge(-1e6), Le(1e6), Remedy("must be from -1e6 to 1e6")] = 0.0
    """The same for experts of variations with an adversary."""
    failed_experts: Literal["refuse", "teach"] = "refuse"
    """``teach``: go on with experts below ``least_return``; a note names them."""
    cache: str = "~/.cache/icrl-dist/experts"
    """Folder that stores histories and experts for later runs; empty: they are not stored."""


NOT_IN_TRAINING = frozenset({"cache", "least_return", "least_return_disturbed", "failed_experts"})
"""Keys that change neither an expert nor its history."""
