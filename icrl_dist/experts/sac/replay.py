"""What N experts remember: a ring of transitions each, filled in lockstep, on the learner's device."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Transitions(NamedTuple):
    """B transitions of each of N experts.

    No flag says that an episode ended: the games end by a time limit only, and the target
    bootstraps through it, so ``following`` is what was seen at the limit, not after the reset.
    """

    observations: Float[Tensor, "N B S"]
    actions: Float[Tensor, "N B A"]
    rewards: Float[Tensor, "N B"]
    following: Float[Tensor, "N B S"]


class Replay:
    """The last ``capacity`` transitions of each expert; a transition is one row of memory."""

    def __init__(self, experts: int, capacity: int, observation: int, actions: int, device: torch.device) -> None:
        self._widths = (observation, actions, 1, observation)
        self._rows = torch.empty(experts, capacity, sum(self._widths), device=device)
        self._first = torch.arange(experts, device=device).unsqueeze(1) * capacity
        self.added = 0
        """Transitions of each expert so far, the forgotten ones too."""

    def __len__(self) -> int:
        return min(self.added, self._rows.shape[1])

    def add(
        self,
        observations: Float[Tensor, "N S"],
        actions: Float[Tensor, "N A"],
        rewards: Float[Tensor, " N"],
        following: Float[Tensor, "N S"],
        lost: Bool[Tensor, " N"] | None = None,
    ) -> None:
        """One transition of each expert, in the oldest's place if there is no other; it goes to the device in one copy.

        Nothing may be learned from those that are ``lost``: the expert's transition before stands in
        their place once more (zeros, if it is the first).
        """
        row = torch.cat([observations, actions, rewards.unsqueeze(1), following], dim=1).to(self._rows.device)
        capacity = self._rows.shape[1]
        if lost is not None and lost.any():
            before = self._rows[:, (self.added - 1) % capacity] if self.added else torch.zeros_like(row)
            row = torch.where(lost.unsqueeze(1).to(row.device), before, row)
        self._rows[:, self.added % capacity] = row
        self.added += 1

    def take(self, picks: Int[Tensor, "N B"]) -> Transitions:
        """Transitions of each expert, by any numbers: modulo those that there are.  Raises IndexError if there are none."""
        if not self.added:
            raise IndexError("nothing to take: add transitions first")
        (experts, batch), width = picks.shape, self._rows.shape[2]
        rows = self._rows.view(-1, width).index_select(0, (picks % len(self) + self._first).flatten())
        observations, actions, rewards, following = torch.split_with_sizes(
            rows.view(experts, batch, width), self._widths, dim=2
        )
        return Transitions(observations, actions, rewards.squeeze(2), following)

    def state(self) -> dict[str, np.ndarray]:
        """Everything remembered: ``rows`` (N, filled, 2 S + A + 1) and ``added``."""
        return {"rows": self._rows[:, : len(self)].cpu().numpy().copy(), "added": np.array(self.added)}

    def load(self, state: dict[str, np.ndarray]) -> None:
        """The inverse of ``state``.  Raises ValueError for another number of experts, capacity or width."""
        rows, added = torch.from_numpy(np.array(state["rows"])), int(state["added"])
        experts, capacity, width = self._rows.shape
        if rows.shape != (experts, min(added, capacity), width):
            raise ValueError(
                f"replay: {tuple(rows.shape)} rows for {added} added do not fit {experts} experts of "
                f"{capacity} transitions, {width} wide: load it into the shape that it was saved from"
            )
        self._rows[:, : rows.shape[1]] = rows.to(self._rows.device)
        self.added = added
