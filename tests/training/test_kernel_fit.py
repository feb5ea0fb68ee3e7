"""The fit through the compiled kernel: torch's loss, gradients and optimizers, the same on all processors and threads."""

from __future__ import annotations

import numpy as np
import pytest

from icrl_dist.models.kernel import kinds
from tests.training.kernel_fits import Case, by_torch

pytestmark = [
    pytest.mark.unit,
    pytest.mark.skipif(not kinds("training"), reason="the training kernel was not built"),
]

CASES = [
    Case(),
    Case(contexts=1, tokens=1, queries=2),
    Case(contexts=1, queries=1, tokens=4),
    Case(layers=1),
    Case(layers=4, tokens=50, queries=40),
    Case(heads=2),
    Case(heads=3, width=24, queries=17),
    Case(heads=4, width=12, tokens=33),
    Case(width=40, heads=4),
    Case(width=64, heads=2, contexts=18, tokens=9),
    Case(fourier=2),
    Case(windows=3, window=4),
    Case(windows=2, window=17, heads=2, fourier=1, layers=3),
    Case(discrete=False, actions=2),
    Case(discrete=False, actions=17, windows=2, window=3),
    Case(actions=18, width=20),
    Case(width=6, heads=2, actions=1, discrete=False),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_loss_and_gradients_are_those_of_torch(case: Case) -> None:
    model = case.model()
    batch = case.batch()
    loss, gradients = by_torch(model, batch)
    own_loss, own = case.fit(model).gradient(batch)
    assert own_loss == pytest.approx(loss, rel=1e-5)
    assert set(own) == set(gradients)
    for name, gradient in gradients.items():
        np.testing.assert_allclose(
            own[name], gradient.numpy(), rtol=0, atol=1e-4 * float(gradient.abs().max()) + 1e-8, err_msg=name
        )


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_neither_threads_nor_instruction_sets_change_a_gradient(case: Case) -> None:
    model = case.model()
    batch = case.batch()
    loss, gradients = case.fit(model).gradient(batch)
    fits = [case.fit(model, threads=threads) for threads in (2, 3)] + [case.fit(model, kind=kind) for kind in kinds("training")]
    for fit in fits:
        own_loss, own = fit.gradient(batch)
        assert own_loss == loss
        for name, gradient in gradients.items():
            np.testing.assert_array_equal(own[name], gradient, err_msg=name)
