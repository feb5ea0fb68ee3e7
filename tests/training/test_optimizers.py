"""The optimizer: whose update each parameter gets, and that a stopped fit goes on as if it had not stopped."""

import copy
import dataclasses
import sys

import numpy as np
import pytest
import torch

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import OptimConfig
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import splits
from icrl_dist.training import batches, fit, optimizers
from icrl_dist.training.batches import Pool
from icrl_dist.training.fit import Optimizer
from learner import checkpoints
from tests.methods.test_recipes import Fixed, Kept

CONFIG = OptimConfig(learning_rate=1e-2, batch=8, queries=4, weight_decay=0.1, beta2=0.9, warmup=2)


@pytest.fixture
def model(small_run):
    torch.manual_seed(0)
    return PretrainedTransformer(splits.spec(small_run), small_run.model)


@pytest.fixture
def batch(small_run):
    from icrl_dist.methods.recipes import METHODS

    from icrl_dist.collect import jobs

    method, run = METHODS["dpt"], dataclasses.replace(small_run, method="dpt")
    (phase,) = method.phases(run)
    data = Kept([t for job in method.ask(run, phase) for t in jobs.do(job, Fixed, "w")])
    pools: tuple[Pool, ...] = method.learn(run, phase, data)
    return lambda step: batches.draw(np.random.default_rng(step), pools, CONFIG.batch, CONFIG.queries)


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_matrices_of_the_trunk_go_by_muon_and_the_rest_by_adamw(model, batch, muon):
    other = copy.deepcopy(model)
    matrices = {n: p for n, p in other.named_parameters() if muon and n.startswith("trunk") and p.ndim == 2}
    rest = [p for n, p in other.named_parameters() if n not in matrices]
    assert len(matrices) == (8 if muon else 0)
    plain: list[torch.optim.Optimizer] = [torch.optim.AdamW(rest, lr=1e-3, weight_decay=0.1, betas=(0.9, 0.9))]
    if matrices:
        plain.append(torch.optim.Muon(matrices.values(), lr=1e-3 * muon, weight_decay=0.0))
    opt = Optimizer(model, dataclasses.replace(CONFIG, muon=muon))
    for step in range(3):
        for one in (model, other):
            fit.batch_loss(one, batch(step)).backward()
        opt.step(1e-3)
        assert all(p.grad is None for p in model.parameters())
        for part in plain:
            part.step()
            part.zero_grad()
    for (name, mine), theirs in zip(model.named_parameters(), other.parameters(), strict=True):
        assert torch.equal(mine, theirs), name


def test_learning_imports_no_compiler(model, batch, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # whoever imports it now fails
    opt = Optimizer(model, dataclasses.replace(CONFIG, muon=5.0))
    fit.batch_loss(model, batch(0)).backward()
    opt.step(1e-3)
    opt.load(opt.state())
    optimizers.Adam([torch.zeros(1, requires_grad=True)], fused=True).step()
    with pytest.raises(ImportError):
        torch.optim.AdamW(model.parameters()).step()


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_a_fit_taken_up_from_a_checkpoint_ends_with_the_same_weights(small_run, model, batch, tmp_path, muon):
    config = dataclasses.replace(CONFIG, muon=muon)
    fresh, spec = copy.deepcopy(model), splits.spec(small_run)

    def half(step, loss):
        if step == 5:
            checkpoints.save(tmp_path / "half.npz", model, opt, {**checkpoints.manifest(small_run, spec, 0, 1)})

    opt = Optimizer(model, config)
    fit.fit(model, opt, config, 1e-2, 10, batch, half)
    again = Optimizer(fresh, config)
    checkpoints.restore(tmp_path / "half.npz", spec, fresh, again)
    fit.fit(fresh, again, config, 1e-2, 10, batch, first=5)
    for mine, theirs in zip(model.parameters(), fresh.parameters(), strict=True):
        assert torch.equal(mine, theirs)
    assert {k: v.tolist() for k, v in opt.state().items()} == {k: v.tolist() for k, v in again.state().items()}


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_a_checkpoint_of_the_other_optimizer_is_refused_in_one_line(small_run, model, batch, tmp_path, muon):
    one, other = (Optimizer(model, dataclasses.replace(CONFIG, muon=m)) for m in (muon, 5.0 - muon))
    fit.batch_loss(model, batch(0)).backward()
    one.step(1e-3)
    spec = splits.spec(small_run)
    checkpoints.save(tmp_path / "one.npz", model, one, checkpoints.manifest(small_run, spec, 0, 1))
    with pytest.raises(ConfigError, match=r"another optimizer .*: it has the run's optim.muon"):
        checkpoints.restore(tmp_path / "one.npz", spec, model, other)
