"""What ``bench disturbance`` needs of a problem: undisturbed experts, and the disturbances that they are measured under."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

from icrl_dist.config.run import load
from icrl_dist.config.sac import SACConfig
from icrl_dist.interfaces import Policy
from icrl_dist.types import Task

Report = Callable[[str], None]
Make = Callable[[Any], Policy]
"""Makes the policy for a batch of environments."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """A disturbance of a problem; strength 1 is the largest force of a preset, or a displacement in meters."""

    forces: str
    """The preset, ``paper`` or ``qarl``; empty in Meta-World."""
    task: Task
    """The task that adversaries are made for; in DeepMind Control the nominal one, in which the expert was trained."""
    outputs: int
    """Components of an adversary's action."""


class DisturbanceExperts(abc.ABC):
    """Undisturbed experts of one problem, and its disturbances."""

    run_file: str
    """Packaged run file with the settings of the experts."""
    steps: int = 0
    """Training steps of an expert where those of the run file are too few; else 0."""
    competent: bool
    """Whether the experts are known to be competent with the settings of the run file."""
    fixed_starts: ClassVar[bool] = False
    """Whether the initial states of a task are fixed, so that more than one episode of it gives nothing new."""
    most_reward: ClassVar[float] = 1.0
    """Largest reward of a step."""
    remedy: ClassVar[str] = "train longer with --steps"
    """What to do about an expert that is not competent."""

    def sac_config(self, steps: int = 0) -> SACConfig:
        """The settings of the experts, with ``steps`` or the default training steps."""
        config = load(self.run_file).sac
        return dataclasses.replace(config, steps=steps or self.steps or config.steps)

    @abc.abstractmethod
    def settings(self) -> list[Setting]:
        """The disturbances of the problem."""

    @abc.abstractmethod
    def tasks(self, setting: Setting, count: int) -> tuple[Task, ...]:
        """The tasks to measure losses in, at most ``count``."""

    @abc.abstractmethod
    def policy(self, config: SACConfig, report: Report) -> Make:
        """The expert of ``tasks``; trains it if it is not in the cache."""

    @abc.abstractmethod
    def calibration_tasks(self, setting: Setting, count: int) -> tuple[Task, ...]:
        """The tasks to calibrate strengths in."""

    @abc.abstractmethod
    def calibration_policy(self, config: SACConfig, report: Report) -> Make:
        """The experts of ``calibration_tasks``, each for the rows of its task; trains those that are not in the cache."""

    @abc.abstractmethod
    def describe(self, setting: Setting, config: SACConfig) -> dict[str, Any]:
        """Fields of a result that name the disturbance: ``meters``, or ``forces``, ``newtons`` and ``steps``."""

    @abc.abstractmethod
    def calibration_key(self, setting: Setting) -> dict[str, Any]:
        """Fields ``forces`` and ``meters`` of a calibrated strength."""

    @abc.abstractmethod
    def expert(self, config: SACConfig) -> str:
        """The expert in words."""
