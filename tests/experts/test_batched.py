"""Updates of experts in lockstep against those of stable-baselines3."""

import dataclasses

import numpy as np
import pytest
import torch

from icrl_dist.experts.sac.batched import SACBatch, pick, train
from icrl_dist.experts.sac.lockstep import sample
from icrl_dist.experts.sac.sb3_expert import Expert
from icrl_dist.types import Spec
from tests.experts.sac_cases import (
    LINE,
    PAPER,
    SMALL,
    SPEC,
    A,
    Line,
    N,
    S,
    max_difference,
    optimizers,
    random_updates,
    through_file,
    updated_by_sb3,
)
from tests.optional import known


@pytest.mark.parametrize(("updates", "actors", "critics"), [(1, 2e-6, 4e-5), (10, 6e-6, 4e-5), (50, 6e-4, 2e-4)])
def test_updates_equal_those_of_stable_baselines3(updates, actors, critics, tmp_path, monkeypatch):
    engine = SACBatch(range(N), SPEC, PAPER, "cpu")
    models = []
    for index in (0, N - 1):
        engine.save_sb3(index, tmp_path / "before.zip")
        models.append(Expert.load(tmp_path / "before.zip", device="cpu"))
    for batch, noise in random_updates(PAPER, updates):
        engine.update(batch, noise)
    for index, model in zip((0, N - 1), models, strict=True):
        updated_by_sb3(model, index, random_updates(PAPER, updates), monkeypatch)
        ours = through_file(engine, index, tmp_path / "after.zip")
        assert max_difference(ours, model, "actor") <= 3 * actors
        assert max_difference(ours, model, "critic") <= 3 * critics
        assert max_difference(ours, model, "critic_target") <= 3 * critics
        assert known(ours.log_ent_coef).item() == pytest.approx(known(model.log_ent_coef).item(), abs=1e-5)


def test_each_expert_has_its_own_gradient_not_the_mean_over_experts(tmp_path, monkeypatch):
    """Compares Adam's moments: its first steps hardly depend on a gradient's size."""
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    engine.save_sb3(1, tmp_path / "before.zip")
    model = updated_by_sb3(Expert.load(tmp_path / "before.zip", device="cpu"), 1, random_updates(SMALL, 3), monkeypatch)
    for batch, noise in random_updates(SMALL, 3):
        engine.update(batch, noise)
    ours = through_file(engine, 1, tmp_path / "after.zip")
    assert len(optimizers(ours)) == len(optimizers(model)) == 3
    for our_adam, other in zip(optimizers(ours), optimizers(model), strict=True):
        assert len(our_adam.state) == len(other.state)
        for mine, theirs in zip(our_adam.state.values(), other.state.values(), strict=True):
            assert mine["step"] == theirs["step"] == 3
            for moment in ("exp_avg", "exp_avg_sq"):
                size = theirs[moment].abs().max()
                assert size > 0
                torch.testing.assert_close(mine[moment], theirs[moment], rtol=1e-3, atol=float(1e-4 * size))


@pytest.mark.parametrize("batch", [16, 48])
def test_an_expert_does_not_depend_on_the_other_experts_to_the_bit(batch):
    config = dataclasses.replace(LINE, batch=batch, hidden=(8, 8), actor_rate=1e-2)
    seeds = [3**n for n in range(37)]
    whole = train(Line(37), config, 63, seeds, device="cpu").state()
    assert whole["updates"] == 18
    for rows in ([0], [36], [7, 20], range(4, 37)):
        part = train(Line(len(rows)), config, 63, [seeds[row] for row in rows], device="cpu").state()
        for name, array in part.items():
            np.testing.assert_array_equal(array, whole[name] if array.ndim == 0 else whole[name][list(rows)], err_msg=name)


def test_gradients_where_the_log_deviation_is_clamped(tmp_path, monkeypatch):
    """Some log deviations are above 2.  At -20 stable-baselines3's float32 has no correct digit; the next test uses float64."""
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    engine.actor_shape.layers(engine.arrays["actor"])[-1][1][..., A:] = torch.tensor([2.0, -6.0, 5.0, 2.5, 0.0, 1.0])
    engine.save_sb3(0, tmp_path / "before.zip")
    model = updated_by_sb3(Expert.load(tmp_path / "before.zip", device="cpu"), 0, random_updates(SMALL, 1), monkeypatch)
    (batch, noise), *_ = random_updates(SMALL, 1)
    engine.update(batch, noise)
    ours = through_file(engine, 0, tmp_path / "after.zip")
    for mine, theirs in zip(ours.actor.parameters(), model.actor.parameters(), strict=True):
        got, wanted = (m.actor.optimizer.state[p]["exp_avg"] for m, p in ((ours, mine), (model, theirs)))
        torch.testing.assert_close(got, wanted, rtol=1e-3, atol=float(1e-4 * wanted.abs().max()))


def test_the_squashed_gaussian_and_its_derivatives_equal_those_of_torch_in_float64():
    g = torch.Generator().manual_seed(0)
    output, noise, weight = (torch.randn(2, 9, n, generator=g, dtype=torch.float64) for n in (2 * A, A, A))
    output[..., A:] = output[..., A:] * 12 - 6
    output.requires_grad_()
    mean, raw = output.chunk(2, 2)
    assert int((raw < -20).sum()) > 0 and int((raw > 2).sum()) > 0
    normal = torch.distributions.Normal(mean, raw.clamp(-20, 2).exp())
    u = mean + raw.clamp(-20, 2).exp() * noise
    likelihood = (normal.log_prob(u) - (1 - u.tanh() ** 2 + 1e-6).log()).sum(2)
    ((weight * u.tanh()).sum() + likelihood.sum()).backward()
    found = sample(output.detach(), noise)
    torch.testing.assert_close(found.actions, u.detach().tanh())
    torch.testing.assert_close(found.log_likelihood, likelihood.detach(), atol=1e-5, rtol=1e-5)
    d_u = found.da_du * (weight + 2 * found.actions / (found.da_du + 1e-6))
    assert output.grad is not None
    torch.testing.assert_close(output.grad[..., :A], d_u, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(output.grad[..., A:], d_u * found.du_dlog - found.unclamped, atol=1e-5, rtol=1e-5)


def test_updates_with_bfloat16_products_follow_those_of_float32():
    """Parameters stay float32, and gradients differ by no more than the precision of bfloat16 (8 bits)."""
    full, half = SACBatch(range(N), SPEC, SMALL, "cpu"), SACBatch(range(N), SPEC, SMALL, "cpu", "bfloat16")
    for batch, noise in random_updates(SMALL, 20):
        full.update(batch, noise)
        half.update(batch, noise)
    for name in ("actor", "critic"):
        wanted, got = full.arrays[f"{name}/exp_avg"], half.arrays[f"{name}/exp_avg"]
        assert got.dtype == torch.float32
        assert float((got - wanted).norm() / wanted.norm()) < 0.05
        moved = half.arrays[name] - full.arrays[name]
        assert 0 < float(moved.norm() / full.arrays[name].norm()) < 0.01


def test_actions_follow_the_squashed_gaussian():
    engine = SACBatch([0], SPEC, SMALL, "cpu")
    weights, bias = engine.actor_shape.layers(engine.arrays["actor"])[-1]
    weights.zero_()
    bias[0, 0] = torch.tensor([0.0, 0.5, -0.5, 0.0, 1.0, 0.2, -1.0, -2.0, -30.0, 9.0, -1.0, -1.0])
    noise = np.random.default_rng(0).standard_normal((1, 20000, A), dtype=np.float32)
    actions = engine.act(np.zeros((1, 20000, S), np.float32), noise)[0].astype(np.float64)
    normal = np.arctanh(np.clip(actions, -1 + 1e-7, 1 - 1e-7))
    np.testing.assert_allclose(np.median(normal, axis=0), [0.0, 0.5, -0.5, 0.0, 1.0, 0.2], atol=0.15)
    np.testing.assert_allclose(normal.std(axis=0)[[0, 1, 2, 4]], np.exp([-1.0, -2.0, -20.0, -1.0]), rtol=0.03, atol=1e-6)
    assert np.quantile(np.abs(normal[:, 3]), 0.3) == pytest.approx(np.exp(2.0) * 0.385, rel=0.05)


def test_settings_that_are_not_supported_are_refused(monkeypatch):
    with pytest.raises(ValueError, match=r"0 experts"):
        SACBatch(range(0), SPEC, SMALL, "cpu")
    with pytest.raises(ValueError, match=r"discrete = True"):
        SACBatch([0], Spec((0.0,), (1.0,), 3, 5), SMALL, "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick("auto").type == "cpu"
    with pytest.raises(ValueError, match="torch finds no GPU"):
        pick("cuda")
    with pytest.raises(ValueError, match=r"actor has the shape \(2, .*not \(1, "):
        state = SACBatch(range(2), SPEC, SMALL, "cpu").state()
        engine = SACBatch([0], SPEC, SMALL, "cpu")
        engine._set_arrays({name: torch.from_numpy(state[name]) for name in engine.arrays}, 0)
