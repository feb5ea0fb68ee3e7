"""Records episodes of a batch of environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32

from icrl_dist.interfaces import Batch
from icrl_dist.types import Step


class Recorder:
    """A batch that forwards every call to ``env`` and records ``recorded`` of its first ``episodes``, evenly spaced."""

    def __init__(self, env: Batch, episodes: int, recorded: int) -> None:
        self.spec, self.batch, self.episodes = env.spec, env.batch, episodes
        self._env, self._number = env, 0
        self._selected = set(np.linspace(0, episodes - 1, min(recorded, episodes)).round().astype(int).tolist())
        self._columns: dict[str, list[np.ndarray]] = {}
        self._running: dict[str, list[np.ndarray]] = {}

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row."""
        self._running = {name: [] for name in ("observations", "actions", "rewards", "adversary", "truths")}
        observation: np.ndarray = self._env.reset(rngs)
        self._observe(observation)
        return observation

    def step(self, actions: Float32[np.ndarray, "B A"]) -> Step:
        """One step in every row."""
        step = self._env.step(actions)
        for name, value in (("actions", actions), ("rewards", step.reward), ("adversary", step.adversary)):
            self._running[name].append(value)
        if step.done:
            self._running["observations"].append(step.observation)
            self._end(step.diverged)
        else:
            self._observe(step.observation)
        return step

    def _observe(self, observation: np.ndarray) -> None:
        self._running["observations"].append(observation)
        truth = getattr(self._env, "truth", None)
        if truth is not None:
            self._running["truths"].append(truth.astype(np.float32))

    def _end(self, diverged: np.ndarray | None) -> None:
        if self._number in self._selected:
            for name, values in self._running.items():
                if values:
                    self._columns.setdefault(name, []).append(np.stack(values, axis=1))
            broken = np.zeros(self.batch, bool) if diverged is None else diverged
            self._columns.setdefault("whole", []).append(~broken)
        self._number += 1

    def state(self) -> dict[str, np.ndarray]:
        """The recorded episodes, as arrays for ``load``."""
        return {"number": np.array(self._number), **{name: np.stack(values) for name, values in self._columns.items()}}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue after the last complete episode of the recorder that gave ``state``."""
        self._number = int(state["number"])
        self._columns = {name: list(values) for name, values in state.items() if name != "number"}

    def columns(self) -> dict[str, np.ndarray]:
        """Arrays (B, E, ...) of E recorded episodes: ``observations``, ``actions``, ``rewards``, ``adversary``.

        ``whole`` (B, E): the simulation did not diverge.  ``truths``: the true states, in a problem that hides
        a part of them.
        """
        return {name: np.stack(values, axis=1) for name, values in self._columns.items()}
