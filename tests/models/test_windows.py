"""Action windows (zeta of eq. 6) in the model and in the loss, and the head of vector actions."""

import math

import numpy as np
import pytest
import torch

from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.deployed import WindowColumns
from icrl_dist.models.dpt import Windows
from icrl_dist.models.heads import Gaussian
from icrl_dist.training.batches import LabelledWindows, TrainingBatch
from tests.models.deployments import Deploy, close, columns
from tests.models.windowed import LENGTH, SPEC, B, R, T, build, part, transitions, windows


@torch.no_grad()
def test_the_first_state_of_a_window_is_a_query_and_windows_do_not_see_each_other():
    model, whole, of = build(SPEC), transitions(), windows()
    prefix = torch.tensor([[0, 7], [3, T], [1, 2]])
    cache = model.encode(whole)
    together = model.decide_windows(of, cache, prefix)
    torch.testing.assert_close(together[:, :, 0], model.decide(of.states[:, :, 0], cache, prefix), atol=1e-5, rtol=1e-5)
    for r in range(R):
        single = model.decide_windows(part(of, slice(None), slice(r, r + 1)), cache, prefix[:, r : r + 1])
        torch.testing.assert_close(single, together[:, r : r + 1], atol=1e-5, rtol=1e-5)
    assert together.std(dim=2).min() > 1e-3, "outputs hardly depend on the state, so this would prove nothing"


@torch.no_grad()
@pytest.mark.parametrize("column", Windows._fields)
@pytest.mark.parametrize("at", range(LENGTH))
def test_a_change_in_a_window_changes_later_outputs_and_no_earlier_one(column, at):
    model, of, cache = build(SPEC), windows(), None
    cache = model.encode(transitions())
    value = getattr(of, column).clone()
    value[:, :, at] = (value[:, :, at] + 1) % 5
    one, two = (model.decide_windows(s, cache, torch.full((B, R), T)) for s in (of, of._replace(**{column: value})))
    moved = (one - two).abs().amax(dim=(0, 1, 3))
    first = at if column == "states" else at + 1
    assert (moved[:first] < 1e-6).all() and (moved[first:] > 1e-4).all()


@torch.no_grad()
@pytest.mark.parametrize("heads", [1, 2])
@pytest.mark.parametrize("together", [set(), {0, 7}, {9, 10}], ids=str)
def test_a_context_that_grows_step_by_step_gives_the_outputs_of_training(
    heads: int, together: set[int], deploy: Deploy
) -> None:
    """Transitions arrive with a decision, or several at once (``together``)."""
    model, whole, of = build(SPEC, heads), transitions(), part(windows(), slice(None), slice(0, 1))
    deployed, t = deploy(model, B), 0
    window = WindowColumns(*(column[:, 0].numpy() for column in of))
    while t < T:
        expected = model.decide_windows(of, model.encode(part(whole, slice(None), slice(0, t + 1))), torch.full((B, 1), t + 1))
        arrived = part(whole, slice(None), slice(t, t + 1))
        close(deployed.decide_window(window, columns(arrived)), expected[:, 0, -1])
        assert deployed.length == t + 1
        close(deployed.decide_window(window), expected[:, 0, -1])
        if t in together:
            deployed.append(columns(part(whole, slice(None), slice(t + 1, t + 4))))
            t += 3
        t += 1
    expected = model.decide(of.states[:, 0, :1], model.encode(whole))[:, 0]
    close(deployed.decide(of.states[:, 0, 0].numpy()), expected)


def test_every_label_has_the_same_weight_in_the_loss():
    model, rng = build(SPEC), np.random.default_rng(0)
    whole, of = transitions(), windows()
    labels, followed_labels = (rng.dirichlet([0.5] * 5, size=shape).astype(np.float32) for shape in ((B, 6), (B, R, LENGTH)))
    prefix, window_prefix = rng.integers(0, T + 1, size=(B, 6)), rng.integers(0, T + 1, size=(B, R))
    queries = rng.integers(0, 5, size=(B, 6, 2)).astype(np.float32)
    s, a, n, r = (column.numpy() for column in whole)
    labelled = LabelledWindows(of.states.numpy(), of.prev_actions.numpy(), of.prev_rewards.numpy(), followed_labels)
    batch = TrainingBatch(s, a, n, r, queries, labels, prefix, labelled, window_prefix)
    cache, total = model.encode(whole), 0.0
    with torch.no_grad():
        logs = model.decide(torch.tensor(queries), cache, torch.tensor(prefix)).log_softmax(-1).numpy()
        total -= (logs * labels).sum()
        logs = model.decide_windows(of, cache, torch.tensor(window_prefix)).log_softmax(-1).numpy()
        total -= (logs * followed_labels).sum()
        assert batch_loss(model, batch).item() == pytest.approx(total / (B * (6 + R * LENGTH)), rel=1e-5)


def test_a_gaussian_head_follows_its_formulas():
    rng = np.random.default_rng(0)
    out, value = rng.normal(size=(3, 4)), rng.uniform(-1, 1, size=(3, 2))
    total = 0.0
    for row in range(3):
        for c in range(2):
            deviation = 0.05 + math.log1p(math.exp(out[row, 2 + c]))
            total += 0.5 * ((value[row, c] - out[row, c]) / deviation) ** 2 + math.log(deviation * math.sqrt(2 * math.pi))
    head = Gaussian(2)
    assert head.loss(torch.tensor(out), torch.tensor(value)).item() == pytest.approx(total / 3)
    assert head.log_likelihood(torch.tensor(out), torch.tensor(value)).shape == (3,)
    u = np.broadcast_to(((np.arange(20001) + 0.5) / 20001)[:, None], (20001, 2))
    narrow = torch.tensor([[0.2, -0.1, -9.0, -2.0]]).expand(20001, 4)
    acted = head.act(narrow, u)
    np.testing.assert_allclose(acted.mean(axis=0), [0.2, -0.1], atol=1e-3)
    np.testing.assert_allclose(acted.std(axis=0), [0.05 + math.log1p(math.exp(-9)), 0.05 + math.log1p(math.exp(-2))], atol=2e-3)
    assert np.abs(head.act(torch.tensor([[9.0, -9.0, 0.0, 0.0]]), np.array([[0.5, 0.5]]))).max() == 1
