"""Payloads of the jobs that collect histories of SAC experts or episodes of scripted policies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from icrl_dist.config.ranges import NotNegative, Positive, Share
from icrl_dist.config.sac import SACConfig
from icrl_dist.types import LabelCounts, Payload


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


@dataclass(frozen=True)
class ExpertHistories(Payload):
    """Histories of SAC experts, from the cache or newly trained."""

    kind: ClassVar[str] = "train_expert"
    arrives_at_once: ClassVar[bool] = True
    sac: SACConfig
    labelling: ExpertLabelling


@dataclass(frozen=True)
class ScriptedContexts(Payload):
    """Episodes of a scripted policy, with noise."""

    kind: ClassVar[str] = "scripted_context"
    labelling: ExpertLabelling
