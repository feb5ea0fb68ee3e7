"""Sections of a run about the continuous games: which tasks and adversaries, and the SAC experts in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from icrl_dist.config.toml import ConfigError

PROBLEMS = (
    "darkroom",
    "metaworld-pick-place",
    "dmc-cartpole-balance",
    "dmc-cartpole-swingup",
    "dmc-cheetah-run",
    "dmc-hopper-stand",
    "dmc-hopper-hop",
    "dmc-quadruped-walk",
    "dmc-quadruped-run",
    "dmc-reacher-easy",
    "dmc-reacher-hard",
    "dmc-walker-walk",
    "dmc-walker-run",
)
"""What a run may be about: the kinds of tasks that ``envs`` makes."""


def horizon(problem: str, given: int = 0) -> int:
    """Steps an episode of a continuous game: those given, or if that is 0 the problem's own."""
    return given or (500 if problem.startswith("metaworld") else 200)


@dataclass(frozen=True)
class ControlConfig:
    """The continuous games (appendix C.2, C.3); without effect in Dark Room."""

    train_tasks: int = 16
    """m, tasks that are trained on.  DeepMind Control: the central 2x2, 4x4 or 6x6 of the 8x8 grid of
    physical parameters (m = 16 in appendix C.3); Meta-World: the first of ML1's (15 in appendix C.2)."""
    test_tasks: int = 5
    """Tasks that are only tested: others of the grid, or ML1's next."""
    horizon: int = 0
    """Steps an episode; 0: the problem's own, 200 in DeepMind Control, 500 in Meta-World."""
    strength: float | str = 1.0
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
    disturbance: float = 0.01
    """Meta-World: metres that an adversary of strength 1 moves a component of what is observed."""


@dataclass(frozen=True)
class SACConfig:
    """The experts: Table 1 of the paper; where it is silent or misprinted, QARL's code."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the hidden layers, ReLU, of the actor and of each of the two critics (Table 1)."""
    actor_rate: float = 1e-4
    """Adam's learning rate for the actor (Table 1)."""
    critic_rate: float = 3e-4
    """Adam's learning rate for the critics (Table 1)."""
    temperature_rate: float = 3e-4
    """Adam's learning rate for the logarithm of the temperature (Table 1)."""
    tau: float = 0.005
    """Share of the critics that the target critics take up at each update (Table 1)."""
    gamma: float = 0.9
    """Discount a step (section 5)."""
    batch: int = 256
    """Transitions an update (Table 1)."""
    random_steps: int = 3_000
    """Steps of uniformly random actions at the start (Table 1)."""
    warmup: int = 5_000
    """Steps before the first update (Table 1)."""
    replay: int = 1_000_000
    """Transitions remembered, at most (Table 1)."""
    temperature: float = 5e-3
    """The first temperature (QARL's code; Table 1's 5*10^3 has lost its sign).  The entropy that it
    is tuned to is -A for A action components."""
    update_every: int = 3
    """Steps an update (QARL's code)."""
    steps: int = 200_000
    """Environment steps of an expert's training."""
    cache: str = "~/.cache/icrl-dist/experts"
    """Where histories and experts are kept, so that a later run need not train them again; empty: nowhere."""

    def __post_init__(self) -> None:
        """Raises ConfigError, naming the number, for one that cannot be."""
        for name in (
            "actor_rate",
            "critic_rate",
            "temperature_rate",
            "batch",
            "replay",
            "temperature",
            "update_every",
            "steps",
        ):
            self._need(name, getattr(self, name) > 0, "above 0")
        self._need("hidden", min(self.hidden, default=0) > 0, "at least one layer, of at least 1 unit each")
        self._need("tau", 0 < self.tau <= 1, "above 0 and at most 1")
        self._need("gamma", 0 <= self.gamma < 1, "in [0, 1)")
        self._need("random_steps", self.random_steps >= 0, "at least 0")
        self._need("warmup", self.warmup >= 1, "at least 1")

    def _need(self, name: str, given: bool, what: str) -> None:
        if not given:
            raise ConfigError(f"sac.{name} = {getattr(self, name)!r}: must be {what}")
