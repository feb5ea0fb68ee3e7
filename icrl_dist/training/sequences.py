"""Training batches of decision transformers: windows of consecutive steps, each with a prompt from another episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float32, Int16, Int64

from icrl_dist.models.segments import PromptBatch, Segments, returns_to_go
from icrl_dist.training.batches import Examples
from icrl_dist.types import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Histories(Examples):
    """The episodes of one variation with their returns-to-go; labels are not used and left out."""

    adversary: Int16[np.ndarray, "E H"] | Float32[np.ndarray, "E H F"]
    to_go: Float32[np.ndarray, "E H"]
    """Returns-to-go that windows hold; ARDT relabels them."""
    observed: Float32[np.ndarray, "E H"]
    """Returns-to-go of the rewards, which prompts hold: a deployed agent knows no others of its own episodes."""

    @classmethod
    def read(cls, episodes: Sequence[Trajectory]) -> Self:
        """The histories of these episodes, with observed returns-to-go in windows too."""
        return cls.made(*(np.stack([getattr(t, of) for t in episodes]) for of in _COLUMNS))

    @classmethod
    def made(
        cls,
        actions: Int16[np.ndarray, "E H"] | Float32[np.ndarray, "E H A"],
        observations: Float32[np.ndarray, "E H+1 S"],
        rewards: Float32[np.ndarray, "E H"],
        adversary: Int16[np.ndarray, "E H"] | Float32[np.ndarray, "E H F"],
    ) -> Self:
        """The histories of E episodes, given as arrays."""
        observed = returns_to_go(rewards)
        return cls(
            actions=actions if actions.ndim == 3 else actions.astype(np.int64),
            observations=observations,
            rewards=rewards,
            queries=np.zeros((0, observations.shape[-1]), np.float32),
            labels=np.zeros((0, actions.shape[-1]), np.float32),
            history=False,
            adversary=adversary,
            to_go=observed,
            observed=observed,
        )

    @property
    def nbytes(self) -> int:
        return super().nbytes + self.adversary.nbytes + self.to_go.nbytes + self.observed.nbytes

    def cut(
        self, to_go: Float32[np.ndarray, "E H"], episodes: Int64[np.ndarray, " B"], first: Int64[np.ndarray, " B"], length: int
    ) -> Segments:
        """Steps ``first`` to ``first + length - 1`` of each of these episodes, without those before 0 and from H on."""
        horizon = to_go.shape[1]
        begin, end = np.maximum(first, 0), np.minimum(first + length, horizon)
        steps = begin[:, None] + np.arange(length)
        valid = steps < end[:, None]
        steps = np.where(valid, steps, 0)

        def column(values: np.ndarray) -> np.ndarray:
            found = values[episodes[:, None], steps]
            found[~valid] = 0
            return found

        return Segments(column(to_go), column(self.observations), column(self.actions), steps, valid)


_COLUMNS = ("actions", "observations", "rewards", "adversary")


@dataclass(frozen=True)
class Drawn:
    """How many windows a batch has, and how they are cut; see ``methods.prompt_dt.PromptDTConfig``."""

    variations: int
    """Variations drawn for a batch (``optim.batch``)."""
    windows: int
    """Windows drawn from each."""
    window: int
    """Steps of a window."""
    prompt: int
    """Steps of a prompt."""
    dropout: float
    """Probability that a prompt is left out."""


def draw(rng: np.random.Generator, histories: Sequence[Histories], how: Drawn, target: float, scale: float) -> PromptBatch:
    """A batch of windows of random variations, each with a prompt from another episode of its variation.

    The first step of a window is uniform from ``1 - window`` to H - 1 and the window is cut to its episode, so every
    step of an episode is in equally many windows, and as many windows begin with the episode as those of a deployed
    agent do.  A variation with a single episode has no prompts.
    """
    prompts, windows = [], []
    for number in rng.integers(0, len(histories), size=how.variations):
        found = histories[int(number)]
        episodes, horizon = found.rewards.shape
        own = rng.integers(0, episodes, size=how.windows)
        first = rng.integers(1 - how.window, horizon, size=how.windows)
        windows.append(found.cut(found.to_go, own, first, how.window))
        other = (own + rng.integers(1, max(2, episodes), size=how.windows)) % episodes
        begin = rng.integers(0, horizon - how.prompt + 1, size=how.windows)
        shown = (rng.random(how.windows) >= how.dropout) & (other != own)
        prompts.append(found.cut(found.observed, other, np.where(shown, begin, horizon), how.prompt))
    prompt, window = (Segments(*(np.concatenate(one) for one in zip(*rows, strict=True))) for rows in (prompts, windows))
    return PromptBatch(prompt, window, target, scale)
