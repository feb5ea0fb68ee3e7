"""RARL's alternation: who learns in which episode."""

from __future__ import annotations

from typing import Literal

from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.sac import SACConfig

Player = Literal["protagonist", "adversary"]
PLAYERS: tuple[Player, Player] = ("protagonist", "adversary")


def learner(episode: int, config: RobustConfig) -> Player:
    """The player that learns in this episode; the other one acts and does not change.

    Each iteration has ``adversary_episodes`` of the adversary, then ``protagonist_episodes`` of the protagonist.
    """
    place = episode % (config.adversary_episodes + config.protagonist_episodes)
    return "adversary" if place < config.adversary_episodes else "protagonist"


def episodes(horizon: int, sac: SACConfig, config: RobustConfig) -> int:
    """Episodes of a training, in whole iterations: the protagonist learns in at most ``sac.steps`` steps.

    At least one iteration.
    """
    iterations = max(1, sac.steps // (horizon * config.protagonist_episodes))
    return iterations * (config.adversary_episodes + config.protagonist_episodes)
