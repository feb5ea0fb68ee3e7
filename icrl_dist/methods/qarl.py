"""QARL (Reddi et al., 2024): RARL with a curriculum over the adversary's rationality, its SAC temperature."""

from __future__ import annotations

from icrl_dist.methods.rarl import RARL


class QARL(RARL):
    """As RARL; the adversary's temperature is drawn from a distribution that moves to 0 as the protagonist succeeds."""

    name = "qarl"
    product = "qarl"
    curriculum = True
