"""Exact expected returns of policies that are fixed within an episode: ``Problem.certify`` of Dark Room."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64

from icrl_dist.problems.darkroom.room import cells
from icrl_dist.problems.darkroom.solver import expected_returns, worst_cases
from icrl_dist.types import Variation


class RoomCertificate:
    """``parts.Certificate`` for rooms of one size."""

    def __init__(self, size: int) -> None:
        self._size = size

    @property
    def states(self) -> Float32[np.ndarray, "C 2"]:
        return cells(self._size)

    def worst(
        self, policies: Float[np.ndarray, "P C A"] | None, variations: Sequence[Variation], p: float
    ) -> Float64[np.ndarray, " B"]:
        return worst_cases(policies, variations, p)

    def expected(self, policies: Float[np.ndarray, "P C A"], variations: Sequence[Variation]) -> Float64[np.ndarray, " B"]:
        return expected_returns(policies, variations)
