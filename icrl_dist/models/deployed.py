"""A deployed transformer, computed by torch (``models.dpt``) or by the kernel (``models.kernel_transformer``)."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Float32, Int64

from icrl_dist.interfaces import Actions


class Columns(NamedTuple):
    """T transitions of each of B contexts, as numpy arrays."""

    observations: Float32[np.ndarray, "B T S"]
    actions: Int64[np.ndarray, "B T"] | Float32[np.ndarray, "B T A"]
    next_observations: Float32[np.ndarray, "B T S"]
    rewards: Float32[np.ndarray, "B T"]


class WindowColumns(NamedTuple):
    """One action window of each of B contexts (zeta_h of eq. 6): L consecutive states, and the action and reward at each."""

    states: Float32[np.ndarray, "B L S"]
    prev_actions: Int64[np.ndarray, "B L"] | Float32[np.ndarray, "B L A"]
    prev_rewards: Float32[np.ndarray, "B L"]


class Deployed(Protocol):
    """T_theta with one growing context per environment (B of them): a decision costs one token.

    Weights are copied: after more training of the model, make a new one.
    """

    state: Float32[np.ndarray, "B D"] | None
    """Final states of the trunk at the last decision; None before the first."""

    @property
    def length(self) -> int:
        """Transitions in each context."""
        ...

    def clear(self) -> None:
        """Empty every context."""
        ...

    def append(self, transitions: Columns) -> None:
        """Append transitions to each context."""
        ...

    def decide(self, states: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B O"]:
        """Outputs of T_theta (``models.heads``) at one query state per context, given the whole context."""
        ...

    def decide_window(self, windows: WindowColumns, arrived: Columns | None = None) -> Float32[np.ndarray, "B O"]:
        """Outputs at the last state of one window per context, given the whole context.

        One transition per context may join the context first (``arrived``).
        """
        ...

    def decide_row(self, row: int, states: Float32[np.ndarray, "Q S"], appended: Columns) -> Float32[np.ndarray, "Q O"]:
        """Outputs at Q query states, given the whole context ``row`` and E more transitions (of this context).

        Equal to ``decide`` for each state.  Nothing changes: later decisions are as without this call.
        """
        ...

    def act(self, outputs: Float32[np.ndarray, "B O"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The action of each row, sampled by its uniform numbers in [0, 1)."""
        ...

    def probabilities(self, outputs: Float32[np.ndarray, "B O"]) -> Float32[np.ndarray, "B A"]:
        """The distribution over discrete actions."""
        ...
