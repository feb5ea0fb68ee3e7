"""Payloads of the jobs that collect histories of SAC experts or episodes of scripted policies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from icrl_dist.config.ranges import NotNegative, Positive, Share
from icrl_dist.config.sac import SACConfig
from icrl_dist.types import LabelCounts, Payload

WINDOW_EPISODES = 8
"""Episodes after training in which the expert acts, from which action windows are cut."""


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
        """The steps of an expert's training in whole episodes, which the trials are taken from, and of its window episodes.

        An expert acts in ``WINDOW_EPISODES`` episodes also if no action windows are cut from them.
        """
        return self.training_steps(self.sac, horizon) + max(WINDOW_EPISODES, self.labelling.window_episodes) * horizon

    @staticmethod
    def training_steps(sac: SACConfig, horizon: int) -> int:
        """The steps of an expert's training in whole episodes."""
        return max(1, sac.steps // horizon) * horizon


@dataclass(frozen=True)
class ScriptedContexts(Payload):
    """Episodes of a scripted policy, with noise."""

    kind: ClassVar[str] = "scripted_context"
    labelling: ExpertLabelling

    def env_steps(self, trials: int, horizon: int) -> int:
        return (trials + self.labelling.window_episodes) * horizon
