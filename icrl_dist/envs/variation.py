"""A variation environment (tau, phi) behind gymnasium's interface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces

from icrl_dist.types import Variation

if TYPE_CHECKING:
    from icrl_dist.envs import Batch

Observation = np.ndarray[Any, np.dtype[np.float32]]


class VariationEnv(gymnasium.Env[Observation, np.int64]):
    """The MDP (S, A, P_{tau,phi}, R_{tau,phi}, gamma, rho_tau) of section 4.1.

    An episode is truncated at the horizon and never terminates.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - gymnasium declares it so
    render_mode: str | None = None

    def __init__(self, variation: Variation, batch: Batch) -> None:
        self.variation = variation
        self._batch = batch
        low, high = (np.array(bound, dtype=np.float32) for bound in (batch.spec.low, batch.spec.high))
        self.observation_space = spaces.Box(low, high)
        self.action_space = spaces.Discrete(batch.spec.actions)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        return self._batch.reset([self.np_random])[0], {}

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise ValueError(f"action {action!r} is not one of 0..{self._batch.spec.actions - 1}")
        step = self._batch.step(np.array([action]))
        return step.observation[0], float(step.reward[0]), False, step.done, {"adversary": int(step.adversary[0])}
