"""Payloads of the jobs that collect histories of SAC experts or episodes of scripted policies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from icrl_dist.config.ranges import NotNegative, Positive, Share
from icrl_dist.config.sac import SACConfig
from icrl_dist.types import LabelCounts, Payload

WINDOW_EPISODES = 8
"""Episodes after training in which the expert acts, from which action windows are cut."""
_LAST_SHARE = 5
"""Checkpoints are kept in the last 1 / ``_LAST_SHARE`` of a training."""


def checkpoint_numbers(config: SACConfig, episodes: int) -> list[int]:
    """After which of a training's ``episodes`` (from 1) its checkpoints are taken, the last one at its end.

    There are fewer than ``config.checkpoints`` if the last fifth of the training has fewer episodes.
    """
    span = min(episodes - 1, episodes // _LAST_SHARE)
    count = min(config.checkpoints, span + 1)
    return [episodes - round(span * number / max(1, count - 1)) for number in reversed(range(count))]


@dataclass(frozen=True)
class ExpertLabelling:
    """How many query states and action windows an expert labels per trajectory."""

    queries: Positive
    """Query states per trajectory."""
    window: Positive
    """States of an action window."""
    windows: NotNegative
    """Action windows per trajectory."""
    decoy_fraction: Share
    """Share of the windows in which another task's expert acts."""

    @property
    def label_counts(self) -> LabelCounts:
        """The labels of each trajectory."""
        return LabelCounts(self.queries + self.windows * self.window, self.windows * self.window, "expert")

    @property
    def window_episodes(self) -> int:
        """Episodes per variation from which action windows are cut: the expert's own, and those of decoys."""
        return WINDOW_EPISODES * (1 + (self.decoy_fraction > 0)) if self.windows else 0


@dataclass(frozen=True)
class ExpertHistories(Payload):
    """Histories of SAC experts, from the cache or newly trained."""

    kind: ClassVar[str] = "train_expert"
    arrives_at_once: ClassVar[bool] = True
    sac: SACConfig
    labelling: ExpertLabelling

    def env_steps(self, trials: int, horizon: int) -> int:
        """The steps of an expert's training in whole episodes, which the trials are taken from, those by which its
        checkpoints are compared, and those of its window episodes.

        An expert acts in ``WINDOW_EPISODES`` episodes also if no action windows are cut from them.
        """
        return self.training_steps(self.sac, horizon) + max(WINDOW_EPISODES, self.labelling.window_episodes) * horizon

    @staticmethod
    def training_steps(sac: SACConfig, horizon: int) -> int:
        """The steps of an expert's training in whole episodes, and of the comparison of its checkpoints."""
        training = max(1, sac.steps // horizon)
        checkpoints = len(checkpoint_numbers(sac, training))
        compared = checkpoints * sac.checkpoint_episodes if checkpoints > 1 else 0
        return (training + compared) * horizon


@dataclass(frozen=True)
class ScriptedContexts(Payload):
    """Episodes of a scripted policy, with noise."""

    kind: ClassVar[str] = "scripted_context"
    labelling: ExpertLabelling

    def env_steps(self, trials: int, horizon: int) -> int:
        return (trials + self.labelling.window_episodes) * horizon
