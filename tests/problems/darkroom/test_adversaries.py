"""The distribution of the override adversary against draws, and its priors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import betainc

from icrl_dist.problems.darkroom.adversaries import ALPHA_RANGE, adversary_set, argmax_distribution, override_distribution
from icrl_dist.types import NULL, Adversary

ALPHAS = [
    (1.0, 1.0, 1.0, 1.0, 1.0),
    (0.05, 0.05, 0.05, 0.05, 2.0),
    (0.05, 2.0, 0.05, 2.0, 0.7),
    (0.06, 0.09, 0.05, 0.2, 0.11),
    (1.9, 0.3, 1.2, 0.8, 0.5),
    (5.0, 6.0, 4.0),
    (0.4, 1.6),
]


@pytest.mark.parametrize("alpha", ALPHAS, ids=str)
def test_argmax_distribution_equals_the_frequency_of_the_largest(alpha: tuple[float, ...]) -> None:
    draws = 200_000
    largest = np.random.default_rng(1).dirichlet(alpha, size=draws).argmax(axis=1)
    seen = np.bincount(largest, minlength=len(alpha)) / draws
    q = argmax_distribution(alpha)
    assert q.sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_less(np.abs(seen - q), 4.5 * np.sqrt(q * (1 - q) / draws) + 1e-9)


def test_argmax_distribution_of_very_small_alphas() -> None:
    """As alpha -> 0 one component takes everything, and it is b with probability alpha_b / sum."""
    scale = 1e-2
    ratio = np.array([1.0, 2.0, 3.0, 4.0, 10.0])
    np.testing.assert_allclose(argmax_distribution(tuple(scale * ratio)), ratio / ratio.sum(), atol=0.05)
    # Dirichlet draws underflow here, so draw log Gamma(a) = log Gamma(a + 1) + log(U) / a.
    rng, alpha, draws = np.random.default_rng(2), scale * ratio, 200_000
    logs = np.log(rng.gamma(alpha + 1, size=(draws, 5))) + np.log(rng.random((draws, 5))) / alpha
    seen = np.bincount(logs.argmax(axis=1), minlength=5) / draws
    q = argmax_distribution(tuple(alpha))
    np.testing.assert_array_less(np.abs(seen - q), 4.5 * np.sqrt(q * (1 - q) / draws))


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0, 2.0, 20.0])
def test_equal_alphas_give_a_uniform_distribution(alpha: float) -> None:
    np.testing.assert_allclose(argmax_distribution((alpha,) * 5), 0.2, atol=1e-9)


@pytest.mark.parametrize("alpha", [(1.0, 2.0), (0.05, 2.0), (0.01, 0.3), (0.05, 0.06), (7.0, 5.0)], ids=str)
def test_two_actions_have_a_closed_form(alpha: tuple[float, float]) -> None:
    """The first component of a Dirichlet of two is Beta distributed: the larger one if above 1/2."""
    first = 1 - betainc(*alpha, 0.5)
    np.testing.assert_allclose(argmax_distribution(alpha), [first, 1 - first], atol=1e-9)


def test_the_distribution_follows_a_permutation_of_alpha() -> None:
    alpha = np.array(ALPHAS[4])
    order = np.array([3, 0, 4, 1, 2])
    np.testing.assert_allclose(argmax_distribution(tuple(alpha[order])), argmax_distribution(tuple(alpha))[order], atol=1e-12)


def test_override_distribution_of_each_family() -> None:
    alpha = ALPHAS[4]
    p, q = override_distribution(Adversary.of("dirichlet", p=0.15, alpha=alpha), 5)
    assert p == 0.15
    np.testing.assert_array_equal(q, argmax_distribution(alpha))
    p, q = override_distribution(Adversary.of("uniform", p=0.4), 5)
    assert p == 0.4
    np.testing.assert_allclose(q, [0.2] * 5)
    assert override_distribution(NULL, 5)[0] == 0.0


@pytest.mark.parametrize("count", [0, 1, 8])
def test_adversary_set_has_k_disturbances_and_no_null_adversary(count: int) -> None:
    made = adversary_set(np.random.default_rng(0), count, 5, 0.2)
    assert len(made) == len(set(made)) == count
    assert all(a.kind == "dirichlet" for a in made)
    assert adversary_set(np.random.default_rng(0), count + 3, 5, 0.2)[:count] == made, "a larger K changes the first ones"


@pytest.mark.parametrize("p_max", [0.2, 0.7])
def test_priors_are_uniform_over_their_ranges(p_max: float) -> None:
    made = adversary_set(np.random.default_rng(0), 1000, 5, p_max)
    p = np.array([a.number("p") for a in made])
    alpha = np.array([a.vector("alpha") for a in made])
    for values, low, high in ((p, 0.0, p_max), (alpha, *ALPHA_RANGE)):
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
        spread = (high - low) / np.sqrt(12 * values.size)
        assert abs(values.mean() - (low + high) / 2) < 4 * spread


def test_priors_repeat_with_the_generator_and_change_with_it() -> None:
    sets = [adversary_set(np.random.default_rng(seed), 4, 5, 0.2) for seed in (0, 0, 1)]
    assert sets[0] == sets[1]
    assert not set(sets[0]) & set(sets[2])
