"""The override adversary of Dark Room (appendix C.1): its exact distribution, and its priors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from icrl_dist.config.toml import nearest
from icrl_dist.problems.checks import check_parameters
from icrl_dist.types import Adversary

ALPHA_RANGE = (0.05, 2.0)
"""Range of each Dirichlet parameter's uniform prior; the paper gives none (docs/decisions/006-adversary-distribution.md)."""


_PARAMETERS = {"null": (), "uniform": ("p",), "dirichlet": ("p", "alpha")}
"""The families of adversaries, and their parameters."""


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
    return q / q.sum()


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


def sample_dirichlet(rng: np.random.Generator, actions: int, p_max: float) -> Adversary:
    """A random adversary phi^{i,k}: p ~ U(0, p_max) and alpha_b ~ U(0.05, 2) (appendix C.1)."""
    p = float(rng.uniform(0.0, p_max))
    return Adversary.of("dirichlet", p=p, alpha=rng.uniform(*ALPHA_RANGE, size=actions))


def adversary_set(rng: np.random.Generator, count: int, actions: int, p_max: float) -> tuple[Adversary, ...]:
    """The K disturbances of one task (section 4.1)."""
    return tuple(sample_dirichlet(rng, actions, p_max) for _ in range(count))
