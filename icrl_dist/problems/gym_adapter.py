"""A variation environment (tau, phi) as a ``gymnasium.Env``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces

from icrl_dist.copies import CopiedWhole
from icrl_dist.types import Variation

if TYPE_CHECKING:
    from icrl_dist.interfaces import Batch

Observation = np.ndarray[Any, np.dtype[np.float32]]
Action = np.int64 | np.ndarray[Any, np.dtype[np.float32]]
"""An integer, or a vector in [-1, 1]."""


Image = np.ndarray[Any, np.dtype[np.uint8]]


class VariationEnv(CopiedWhole, gymnasium.Env[Observation, Action]):
    """The MDP (S, A, P_{tau,phi}, R_{tau,phi}, gamma, rho_tau) of section 4.1.

    An episode is truncated at the horizon or when the simulation breaks down (``info["diverged"]``); it is
    never terminated.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - gymnasium's declaration

    def __init__(self, variation: Variation, batch: Batch, render_mode: str | None = None) -> None:
        """Raises ValueError for a ``render_mode`` other than ``rgb_array`` or None."""
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r}: choose 'rgb_array', or None for no images")
        self.variation, self.render_mode = variation, render_mode
        self._batch = batch
        low, high = (np.array(bound, dtype=np.float32) for bound in (batch.spec.low, batch.spec.high))
        self.observation_space = spaces.Box(low, high)
        spec = batch.spec
        self.action_space = spaces.Discrete(spec.actions) if spec.discrete else spaces.Box(-1.0, 1.0, (spec.actions,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        return self._batch.reset([self.np_random])[0], {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            actions = self._batch.spec.actions
            known = f"one of 0..{actions - 1}" if self._batch.spec.discrete else f"{actions} float32 numbers in [-1, 1]"
            raise ValueError(f"action {action!r} is not {known}")
        step = self._batch.step(np.array([action]))
        adversary = step.adversary[0]
        info: dict[str, Any] = {"adversary": int(adversary) if adversary.ndim == 0 else adversary}
        over = step.done
        if step.diverged is not None:
            info["diverged"] = bool(step.diverged[0])
            over = over or info["diverged"]
        return step.observation[0], float(step.reward[0]), False, over, info

    def render(self) -> Image | None:
        """The present state as an image ``(height, width, 3)``; None without a ``render_mode``.

        Raises RuntimeError, with the remedy, if MuJoCo cannot render on this node.
        """
        batch: Any = self._batch  # ``Batch`` does not declare ``image``
        return None if self.render_mode is None else batch.image(0)
