"""ARDT's return nets: the expectile loss, the loss of both nets, and the minimax returns of a game of two steps."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from icrl_dist.training.return_nets import ReturnNets, Settings, expectile_loss, minimax_loss
from icrl_dist.training.sequences import Histories
from icrl_dist.types import Spec

SETTINGS = Settings(alpha=0.01, leaf_weight=0.9, steps=1000, batch=8, width=32, learning_rate=1e-2)
SPEC = Spec((0.0,), (1.0,), actions=2, horizon=2)


@pytest.mark.parametrize("alpha", [0.01, 0.3, 0.5, 0.99])
def test_the_expectile_loss_and_its_minimizer_against_loops(alpha: float) -> None:
    targets = np.random.default_rng(0).normal(size=50)

    def loss(prediction: float) -> float:
        errors = [y - prediction for y in targets]
        return sum((alpha if e > 0 else 1 - alpha) * e * e for e in errors) / len(errors)

    for prediction in (-1.0, 0.2):
        error = torch.from_numpy(targets - prediction)
        assert expectile_loss(error, alpha).item() == pytest.approx(loss(prediction))
    low = expectile(targets, alpha)
    assert loss(low) < min(loss(low - 1e-3), loss(low + 1e-3))
    found = torch.zeros((), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([found], lr=1.0, max_iter=200, tolerance_grad=1e-12, tolerance_change=1e-14)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = expectile_loss(torch.from_numpy(targets) - found, alpha)
        value.backward()
        return value

    for _ in range(20):
        optimizer.step(closure)
    assert found.item() == pytest.approx(low, abs=1e-4)
    if alpha == 0.5:
        assert low == pytest.approx(targets.mean())


def test_the_loss_of_both_nets_against_a_loop_and_its_gradients() -> None:
    rng = np.random.default_rng(1)
    q1, q2, rewards = (torch.tensor(rng.normal(size=(4, 3)), requires_grad=True) for _ in range(3))

    def weighted(error: float, alpha: float) -> float:
        return (alpha if error > 0 else 1 - alpha) * error**2

    rows = range(4)
    a, b, r = (x.detach().numpy() for x in (q1, q2, rewards))
    tree = np.mean([weighted(r[n, h] + a[n, h + 1] - b[n, h], 0.8) for n in rows for h in range(2)])
    leaf = np.mean([(r[n, 2] - b[n, 2]) ** 2 for n in rows])
    first = np.mean([weighted(b[n, h] - a[n, h], 0.2) for n in rows for h in range(3)])
    found = minimax_loss(q1, q2, rewards, 0.2, 0.9)
    assert found.item() == pytest.approx(0.1 * tree + 0.9 * leaf + first)
    found.backward()
    # Each net learns from the other, and is not moved towards it.
    only = torch.autograd.grad(expectile_loss(q2.detach() - q1, 0.2), q1)[0]
    assert q1.grad is not None
    torch.testing.assert_close(q1.grad, only)


def game() -> Histories:
    """Every episode of a game of two steps: the agent's action a, and the adversary's b, which is -1, 0 or 1.

    The rewards of both steps are 2 a + (1 if b is -1, 0 if b is 0, -2 if b is 1) * (1 + a).
    """
    rows = list(itertools.product((0, 1), (-1, 0, 1), (0, 1), (-1, 0, 1)))
    actions, adversary = (np.array([(row[i], row[i + 2]) for row in rows]) for i in (0, 1))
    rewards = (2 * actions + np.array([0, -2, 1])[adversary] * (1 + actions)).astype(np.float32)
    states = np.zeros((len(rows), 3, 1), np.float32)
    return Histories.made(actions.astype(np.int16), states, rewards, adversary.astype(np.int16))


def fitted(settings: Settings, seed: int = 0) -> np.ndarray:
    nets, one = ReturnNets(SPEC, 0, settings, 1, seed), game()
    nets.fit([one], [0])
    return nets.relabelled(0, one)


def expectile(values: np.ndarray, alpha: float) -> float:
    """The expectile of numbers, by bisection: it balances the weighted distances to those above and below."""
    low, high = values.min(), values.max()
    for _ in range(60):
        middle = (low + high) / 2
        above, below = (np.maximum(sign * (values - middle), 0).sum() for sign in (1, -1))
        low, high = (middle, high) if alpha * above > (1 - alpha) * below else (low, middle)
    return float(low)


def table(one: Histories, alpha: float) -> np.ndarray:
    """Q1 at every step of the game, backward, by a table."""
    found = np.zeros(one.rewards.shape)
    for h in (1, 0):
        targets = one.rewards[:, h] + (found[:, 1] if h == 0 else 0)
        second = np.zeros(len(targets))
        for a, b in itertools.product((0, 1), (-1, 0, 1)):
            same = (one.actions[:, h] == a) & (one.adversary[:, h] == b)
            second[same] = targets[same].mean() if h == 1 else expectile(targets[same], 1 - alpha)
        for a in (0, 1):
            same = one.actions[:, h] == a
            found[same, h] = expectile(second[same], alpha)
    return found


@pytest.mark.integration
@pytest.mark.parametrize("alpha", [0.1, 0.5])
def test_relabelled_returns_are_those_of_a_table(alpha: float) -> None:
    one = game()
    found, expected = fitted(replace(SETTINGS, alpha=alpha)), table(one, alpha)
    assert found == pytest.approx(expected, abs=0.35)
    same = {(a, h): found[one.actions[:, h] == a, h] for a in (0, 1) for h in (0, 1)}
    assert all(np.ptp(values) < 1e-4 for values in same.values()), "Q(s, a) does not depend on the adversary's action"


def test_the_table_is_minimax_for_alpha_near_0_and_the_mean_return_for_one_half() -> None:
    """Worst case: a = 0 earns -2, a = 1 earns 2 - 4 = -2; so -2 at the last step, and -4 at the first."""
    one = game()
    assert table(one, 1e-6) == pytest.approx(np.tile([-4.0, -2.0], (36, 1)), abs=1e-4)
    means = [[one.observed[one.actions[:, h] == row[h], h].mean() for h in (0, 1)] for row in one.actions]
    assert table(one, 0.5) == pytest.approx(np.array(means), abs=1e-6)


def test_equal_seeds_give_equal_nets_and_the_generator_of_torch_is_not_used() -> None:
    short = replace(SETTINGS, steps=5)
    state = torch.get_rng_state()
    one = fitted(short)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(5)
    np.testing.assert_array_equal(fitted(short), one)
    assert (fitted(short, seed=1) != one).any()


def test_nets_are_fitted_and_asked_by_one_thread_so_a_resumed_run_relabels_alike() -> None:
    """Returns-to-go that left the cache are computed again, during the fit of the transformer and with its threads."""
    nets, one, seen = ReturnNets(SPEC, 0, replace(SETTINGS, steps=3), 1, 0), game(), []
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    hook = torch.nn.modules.module.register_module_forward_hook(lambda *_: seen.append(torch.get_num_threads()))
    try:
        nets.fit([one], [0])
        nets.relabelled(0, one)
        assert torch.get_num_threads() == 3
    finally:
        hook.remove()
        torch.set_num_threads(before)
    assert set(seen) == {1}


def test_a_fit_that_diverges_says_what_to_lower() -> None:
    with pytest.raises(FloatingPointError, match=r"lower ardt\.learning_rate"):
        fitted(replace(SETTINGS, learning_rate=1e30, steps=50))
