"""A variation environment (tau, phi) as a ``gymnasium.Env``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces

from icrl_dist import arrays
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
        self._no_step = "no episode has begun; call reset first"
        """Why no step is possible now; empty within an episode."""
        self._closed = False
        low, high = (np.array(bound, dtype=np.float32) for bound in (batch.spec.low, batch.spec.high))
        self.observation_space = spaces.Box(low, high)
        spec = batch.spec
        self.action_space = spaces.Discrete(spec.actions) if spec.discrete else spaces.Box(-1.0, 1.0, (spec.actions,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.  Raises ValueError for a negative ``seed`` and for any ``options``: there are none."""
        self._check_open()
        seed = None if seed is None else arrays.whole("seed", seed, 0)
        if options:
            raise ValueError(f"options = {arrays.short(options)}: a reset has none; set the task's parameters in Task.of")
        super().reset(seed=seed)
        observation = self._batch.reset([self.np_random])
        self._no_step = ""
        return np.array(observation[0]), {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step; lists and torch tensors are actions too, and floats that hold the number of a discrete action.

        Raises ValueError for another action, RuntimeError before a reset, after the end of an episode and after ``close``.
        """
        self._check_open()
        if self._no_step:
            raise RuntimeError(f"step: {self._no_step}")
        of = self._batch.spec
        chosen = (
            arrays.choices("action", action, (), of.actions) if of.discrete else arrays.vectors("action", action, (of.actions,))
        )
        step = self._batch.step(chosen[None])
        adversary = step.adversary[0]
        info: dict[str, Any] = {"adversary": int(adversary) if adversary.ndim == 0 else np.array(adversary)}
        if step.done:
            self._no_step = f"stepped past the horizon of {of.horizon}; call reset first"
        if step.diverged is not None:
            info["diverged"] = bool(step.diverged[0])
            if info["diverged"]:
                self._no_step = "the simulation broke down in this episode; call reset first"
        return np.array(step.observation[0]), float(step.reward[0]), False, bool(self._no_step), info

    def render(self) -> Image | None:
        """The present state as an image ``(height, width, 3)``; None without a ``render_mode``.

        Raises RuntimeError, with the remedy, if MuJoCo cannot render on this node, before a reset and after ``close``.
        """
        self._check_open()
        batch: Any = self._batch  # ``Batch`` does not declare ``image``
        if self.render_mode is None:
            return None
        if self._no_step.startswith("no episode"):
            raise RuntimeError(f"render: {self._no_step}")
        image: Image = batch.image(0)
        return image

    def close(self) -> None:
        """End the use of this environment; later calls but ``close`` raise RuntimeError."""
        self._closed = True

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("this environment is closed; make another one")
