"""Payloads of the jobs that train robust policies, or label by them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from icrl_dist.config.ranges import NotNegativeFloat
from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.adversarial import schedule
from icrl_dist.experts.payloads import WINDOW_EPISODES, ExpertHistories
from icrl_dist.stream.schema import as_data
from icrl_dist.types import LabelCounts, Payload

_CURRICULUM = (
    "bound",
    "first_concentration",
    "last_concentration",
    "rate",
    "divergence",
    "teacher_episodes",
    "most_temperature",
)
"""Settings that only QARL has."""


@dataclass(frozen=True)
class Game:
    """A training against an adversary that learns."""

    strength: NotNegativeFloat
    """Of the adversary's largest action, as ``control.strength``."""
    settings: RobustConfig
    curriculum: bool
    """True: QARL; False: RARL."""

    def key(self) -> dict[str, object]:
        """What decides the bytes of its policies beside task, seed and ``SACConfig``, for the key of the cache."""
        used = {name: value for name, value in as_data(self.settings).items() if self.curriculum or name not in _CURRICULUM}
        return {"strength": self.strength, "curriculum": self.curriculum, **used}

    def env_steps(self, horizon: int, sac: SACConfig) -> int:
        """The steps of both players' training in each task, and of the episodes after it."""
        return (schedule.episodes(horizon, sac, self.settings) + WINDOW_EPISODES) * horizon


@dataclass(frozen=True)
class RobustPolicies(Payload):
    """Robust policies, from the cache or newly trained; a trajectory is an undisturbed episode of the trained protagonist."""

    kind: ClassVar[str] = "train_robust"
    needs: ClassVar[tuple[str, ...]] = ("second_player",)
    arrives_at_once: ClassVar[bool] = True
    sac: SACConfig
    game: Game

    @property
    def labels(self) -> LabelCounts:
        """None: nothing is fitted to these trajectories."""
        return LabelCounts(0, 0, "none")

    def env_steps(self, trials: int, horizon: int) -> int:
        expert = ExpertHistories.training_steps(self.sac, horizon) + WINDOW_EPISODES * horizon if self.game.curriculum else 0
        return self.game.env_steps(horizon, self.sac) + expert


@dataclass(frozen=True)
class RobustlyLabelledHistories(ExpertHistories):
    """Histories of SAC experts as ``ExpertHistories`` has them, labelled by the robust policy of each task (IC2RL)."""

    kind: ClassVar[str] = "robust_labels"
    needs: ClassVar[tuple[str, ...]] = ("second_player",)
    game: Game

    def env_steps(self, trials: int, horizon: int) -> int:
        return super().env_steps(trials, horizon) + self.game.env_steps(horizon, self.sac)
