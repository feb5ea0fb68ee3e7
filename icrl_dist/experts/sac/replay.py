"""The replay of N experts: one ring buffer of transitions each, filled in lockstep, on the training device."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class ReplayBatch(NamedTuple):
    """B transitions of each of N experts.

    There is no flag for the end of an episode: episodes end only by a time limit, and the target
    bootstraps through it, so ``next_observations`` are those at the limit, not after the reset.
    """

    observations: Float[Tensor, "N B S"]
    actions: Float[Tensor, "N B A"]
    rewards: Float[Tensor, "N B"]
    next_observations: Float[Tensor, "N B S"]


class Replay:
    """The last ``capacity`` transitions of each expert; a transition is one row of a matrix."""

    def __init__(self, experts: int, capacity: int, observation: int, actions: int, device: torch.device) -> None:
        self._widths = (observation, actions, 1, observation)
        self._rows = torch.empty(experts, capacity, sum(self._widths), device=device)
        self._first = torch.arange(experts, device=device).unsqueeze(1) * capacity
        self.added = 0
        """Transitions added per expert so far, including overwritten ones."""

    def __len__(self) -> int:
        return min(self.added, self._rows.shape[1])

    def add(
        self,
        observations: Float[Tensor, "N S"],
        actions: Float[Tensor, "N A"],
        rewards: Float[Tensor, " N"],
        next_observations: Float[Tensor, "N S"],
        diverged: Bool[Tensor, " N"] | None = None,
    ) -> None:
        """Add one transition per expert; when full, it replaces the oldest.  One copy moves all to the device.

        A transition of a ``diverged`` simulation is replaced by a copy of the expert's previous one (zeros,
        if it is the first), so that nothing is learned from it.
        """
        row = torch.cat([observations, actions, rewards.unsqueeze(1), next_observations], dim=1).to(self._rows.device)
        capacity = self._rows.shape[1]
        if diverged is not None and diverged.any():
            before = self._rows[:, (self.added - 1) % capacity] if self.added else torch.zeros_like(row)
            row = torch.where(diverged.unsqueeze(1).to(row.device), before, row)
        self._rows[:, self.added % capacity] = row
        self.added += 1

    def take(self, picks: Int[Tensor, "N B"]) -> ReplayBatch:
        """The transitions with these numbers, modulo the length of the replay.  Raises IndexError if it is empty."""
        if not self.added:
            raise IndexError("the replay is empty: add transitions first")
        # One index_select over all experts: expert n's rows start at n * capacity in the flattened replay.
        (experts, batch), width = picks.shape, self._rows.shape[2]
        rows = self._rows.view(-1, width).index_select(0, (picks % len(self) + self._first).flatten())
        observations, actions, rewards, next_observations = torch.split_with_sizes(
            rows.view(experts, batch, width), self._widths, dim=2
        )
        return ReplayBatch(observations, actions, rewards.squeeze(2), next_observations)

    def state(self) -> dict[str, np.ndarray]:
        """The content: ``rows`` (N, filled, 2 S + A + 1) and ``added``."""
        return {"rows": self._rows[:, : len(self)].cpu().numpy().copy(), "added": np.array(self.added)}

    def load(self, state: dict[str, np.ndarray]) -> None:
        """The inverse of ``state``.  Raises ValueError if the number of experts, the capacity or the width differs."""
        rows, added = torch.from_numpy(np.require(state["rows"], requirements="W")), int(state["added"])
        experts, capacity, width = self._rows.shape
        if rows.shape != (experts, min(added, capacity), width):
            raise ValueError(
                f"replay: {tuple(rows.shape)} rows for {added} added do not fit {experts} experts of "
                f"{capacity} transitions of {width} values: load it into a replay of the shape that it was saved from"
            )
        self._rows[:, : rows.shape[1]] = rows.to(self._rows.device)
        self.added = added
