"""The adversaries of Dark Room: overrides (appendix C.1), winds and permuted controls; exact distributions and priors."""

from __future__ import annotations

import functools
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int

from icrl_dist.config.toml import nearest
from icrl_dist.problems.checks import check_parameters
from icrl_dist.types import Adversary

ALPHA_RANGE = (0.05, 2.0)
"""Range of each Dirichlet parameter's uniform prior; the paper gives none (docs/decisions/006-adversary-distribution.md)."""


_PARAMETERS = {
    "null": (),
    "uniform": ("p",),
    "dirichlet": ("p", "alpha"),
    "wind": ("p", "direction"),
    "permuted": ("p", "permutation"),
}
"""The families of adversaries, and their parameters."""

Disturbance = Literal["override", "wind", "permuted"]
"""What the adversaries of a run do: see ``DarkRoomConfig.disturbance``."""
DIRECTIONS = 4
"""Directions of a wind: +x, -x, +y, -y, as the first four actions."""
SYMMETRIES = (
    (1, 0, 3, 2, 4),
    (2, 3, 1, 0, 4),
    (3, 2, 0, 1, 4),
    (1, 0, 2, 3, 4),
    (0, 1, 3, 2, 4),
    (2, 3, 0, 1, 4),
    (3, 2, 1, 0, 4),
)
"""The permutations of training and test: three rotations of the four moves, then their four mirror images."""


@functools.lru_cache(maxsize=4096)
def argmax_distribution(alpha: tuple[float, ...]) -> Float64[np.ndarray, " A"]:
    """q_b = P(argmax of x ~ Dirichlet(alpha) is b), to about 1e-9.

    x is a normalized vector of independent Gamma(alpha_b) variables, so
    q_b = integral of f_b(t) * prod_{c != b} F_c(t) dt.  With t = exp(y) the integrand is smooth
    and vanishes at both ends, so the trapezoid rule converges exponentially.
    """
    from scipy.special import gammainc, gammaln  # imported here because it is slow and most commands do not need it

    a = np.asarray(alpha, dtype=np.float64)[:, None]
    y = np.linspace(-120.0, 7.0, 6001)[None, :]
    t = np.exp(y)
    log_density = a * y - t - gammaln(a)
    cdf = gammainc(a, t)
    others = np.stack([np.prod(np.delete(cdf, b, axis=0), axis=0) for b in range(len(alpha))])
    q = np.trapezoid(np.exp(log_density) * others, y[0], axis=1)
    q /= q.sum()
    q.flags.writeable = False  # later callers get the same array
    return q


def is_override(adversary: Adversary) -> bool:
    """False for a wind and for permuted controls, whose effect depends on the agent's action."""
    return adversary.kind not in ("wind", "permuted")


def disturbed_moves(adversary: Adversary, actions: int) -> tuple[float, Int[np.ndarray, " A"]]:
    """``(p, moves)`` of a wind or of permuted controls: with probability p action a makes the move ``moves[a]``.

    The moves are numbered as in ``room.next_move``.  Raises ValueError for an impossible p, direction or
    permutation.
    """
    check_parameters(adversary, _PARAMETERS[adversary.kind])
    p = adversary.number("p")
    if not 0.0 <= p <= 1.0:
        raise ValueError(f"{adversary.kind} p={p}: the probability of a disturbance must lie in [0, 1]")
    if adversary.kind == "wind":
        direction = adversary.number("direction")
        if direction not in range(DIRECTIONS):
            raise ValueError(f"wind direction={direction}: expected 0, 1, 2 or 3 (+x, -x, +y, -y)")
        return p, actions + DIRECTIONS * np.arange(actions) + int(direction)
    permutation = adversary.vector("permutation")
    if sorted(permutation) != list(range(actions)):
        raise ValueError(
            f"permuted permutation={permutation}: expected each of 0 to {actions - 1} once; action a executes permutation[a]"
        )
    return p, np.array(permutation, np.int64)


def move_distribution(adversary: Adversary, actions: int) -> Float64[np.ndarray, "A X"]:
    """P(move | action) under any adversary; the moves are numbered as in ``room.next_move``.

    Raises ValueError for an impossible adversary.
    """
    result = np.zeros((actions, actions * (1 + DIRECTIONS)))
    action = np.arange(actions)
    if is_override(adversary):
        p, q = override_distribution(adversary, actions)
        result[:, :actions] = p * q
    else:
        p, moves = disturbed_moves(adversary, actions)
        result[action, moves] = p
    result[action, action] += 1.0 - p
    return result


def override_distribution(adversary: Adversary, actions: int) -> tuple[float, Float64[np.ndarray, " A"]]:
    """``(p, q)``: with probability p the executed action is drawn from q.

    Raises ValueError if p is outside [0, 1], or for an unknown family or parameter, with the nearest name.
    """
    if adversary.kind not in _PARAMETERS:
        families = tuple(_PARAMETERS)
        raise ValueError(
            f"adversary {adversary.kind!r}{nearest(adversary.kind, families)}: Dark Room has {', '.join(families)}"
        )
    check_parameters(adversary, _PARAMETERS[adversary.kind])
    if adversary.kind == "null":
        return 0.0, np.full(actions, 1.0 / actions)
    p = adversary.number("p")
    if not 0.0 <= p <= 1.0:
        raise ValueError(f"adversary p={p}: the probability of an override must lie in [0, 1]")
    if adversary.kind == "uniform":
        return p, np.full(actions, 1.0 / actions)
    alpha = tuple(float(a) for a in adversary.vector("alpha"))
    if len(alpha) != actions or min(alpha) <= 0:
        raise ValueError(f"adversary alpha={alpha}: expected {actions} numbers above 0, one per action")
    return p, argmax_distribution(alpha)


def sample_dirichlet(rng: np.random.Generator, actions: int, p_max: float, p_min: float = 0.0) -> Adversary:
    """A random adversary phi^{i,k}: p ~ U(p_min, p_max) and alpha_b ~ U(0.05, 2) (appendix C.1)."""
    p = float(rng.uniform(p_min, p_max))
    return Adversary.of("dirichlet", p=p, alpha=rng.uniform(*ALPHA_RANGE, size=actions))


def sample(rng: np.random.Generator, disturbance: Disturbance, actions: int, p_max: float, p_min: float = 0.0) -> Adversary:
    """A random adversary: p ~ U(p_min, p_max); the rest uniform: alpha, one of four directions, one of ``SYMMETRIES``."""
    if disturbance == "override":
        return sample_dirichlet(rng, actions, p_max, p_min)
    p = float(rng.uniform(p_min, p_max))
    if disturbance == "wind":
        return Adversary.of("wind", p=p, direction=int(rng.integers(DIRECTIONS)))
    return Adversary.of("permuted", p=p, permutation=SYMMETRIES[int(rng.integers(len(SYMMETRIES)))])


def adversary_set(
    rng: np.random.Generator,
    count: int,
    actions: int,
    p_max: float,
    disturbance: Disturbance = "override",
    p_min: float = 0.0,
) -> tuple[Adversary, ...]:
    """The K disturbances of one task (section 4.1)."""
    return tuple(sample(rng, disturbance, actions, p_max, p_min) for _ in range(count))


def grid(disturbance: Disturbance, actions: int, p_max: float, levels: int, p_min: float = 0.0) -> tuple[Adversary, ...]:
    """Adversaries, all equally likely, that stand for the prior of ``sample``: about ``4 * levels`` or ``7 * levels`` of them.

    A wind: every direction with each of ``levels`` values of p, the midpoints of equal parts of [p_min, p_max].  Permuted
    controls: every one of ``SYMMETRIES`` with each value.  Overrides: ``4 * levels`` draws of ``sample_dirichlet`` with
    those values of p and alphas that are always the same.
    """
    values = [p_min + (p_max - p_min) * (level + 0.5) / levels for level in range(levels)]
    if disturbance == "wind":
        return tuple(Adversary.of("wind", p=p, direction=direction) for p in values for direction in range(DIRECTIONS))
    if disturbance == "permuted":
        return tuple(Adversary.of("permuted", p=p, permutation=one) for p in values for one in SYMMETRIES)
    rng = np.random.default_rng(0)
    return tuple(sample_dirichlet(rng, actions, 1.0).replace(p=p) for p in values for _ in range(DIRECTIONS))
