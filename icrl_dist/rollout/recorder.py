"""Episodes of a batch of environments, remembered as they pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32

from icrl_dist.interfaces import Batch
from icrl_dist.types import Step


class Recorder:
    """A batch that passes everything on, and remembers ``kept`` of its first ``episodes``, evenly spaced."""

    def __init__(self, env: Batch, episodes: int, kept: int) -> None:
        self.spec, self.batch, self.episodes = env.spec, env.batch, episodes
        self._env, self._number = env, 0
        self._wanted = set(np.linspace(0, episodes - 1, min(kept, episodes)).round().astype(int).tolist())
        self._columns: dict[str, list[np.ndarray]] = {}
        self._now: dict[str, list[np.ndarray]] = {}

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row."""
        self._now = {name: [] for name in ("observations", "actions", "rewards", "adversary", "truths")}
        seen: np.ndarray = self._env.reset(rngs)
        self._see(seen)
        return seen

    def step(self, actions: Float32[np.ndarray, "B A"]) -> Step:
        """Act in every row."""
        step = self._env.step(actions)
        for name, value in (("actions", actions), ("rewards", step.reward), ("adversary", step.adversary)):
            self._now[name].append(value)
        if step.done:
            self._now["observations"].append(step.observation)
            self._end(step.diverged)
        else:
            self._see(step.observation)
        return step

    def _see(self, seen: np.ndarray) -> None:
        self._now["observations"].append(seen)
        truth = getattr(self._env, "truth", None)
        if truth is not None:
            self._now["truths"].append(truth.astype(np.float32))

    def _end(self, diverged: np.ndarray | None) -> None:
        if self._number in self._wanted:
            for name, values in self._now.items():
                if values:
                    self._columns.setdefault(name, []).append(np.stack(values, axis=1))
            lost = np.zeros(self.batch, bool) if diverged is None else diverged
            self._columns.setdefault("whole", []).append(~lost)
        self._number += 1

    def state(self) -> dict[str, np.ndarray]:
        """What ``load`` needs."""
        return {"number": np.array(self._number), **{name: np.stack(values) for name, values in self._columns.items()}}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where another recorder was after its last whole episode."""
        self._number = int(state["number"])
        self._columns = {name: list(values) for name, values in state.items() if name != "number"}

    def columns(self) -> dict[str, np.ndarray]:
        """The episodes, ``(N, E, ...)`` each: ``observations``, ``actions``, ``rewards``, ``adversary``;
        ``whole``, which did not break down; where a game hides something, ``truths``.
        """
        return {name: np.stack(values, axis=1) for name, values in self._columns.items()}
