"""A game of two players on a line, and settings with which its players train in a second."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.sac import SACConfig
from icrl_dist.types import Spec, Step

HORIZON = 7
SAC = SACConfig(hidden=(8,), batch=16, random_steps=9, warmup=10, update_every=2, steps=HORIZON * 8, replay=1000, gamma=0.9)
ROBUST = RobustConfig(adversary_episodes=1, protagonist_episodes=2, teacher_episodes=2)


class Tug:
    """N positions on a line.  Agent and adversary move them, each row draws its start, and the reward is the position.

    Row r gives a step of the agent ``gains[r]`` times its size.
    """

    def __init__(self, gains: Sequence[float], horizon: int = HORIZON) -> None:
        self.spec, self.batch = Spec((-9.0, 0.0), (9.0, 9.0), 1, horizon, discrete=False), len(gains)
        self.disturbance = 2
        self.gains = np.array(gains, np.float32)

    def _observation(self) -> np.ndarray:
        return np.stack([self.at, np.full(self.batch, self.time)], axis=1).astype(np.float32)

    def reset(self, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        self.time, self.at = 0, np.array([rng.uniform(-1, 1) for rng in rngs], np.float32)
        return self._observation()

    def step(self, actions: np.ndarray, disturbances: np.ndarray) -> Step:
        self.time += 1
        self.at = self.at + self.gains * actions[:, 0] + disturbances[:, 0] - disturbances[:, 1]
        return Step(self._observation(), self.at, self.time == self.spec.horizon, disturbances.copy())
