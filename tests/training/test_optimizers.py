"""The optimizer: Muon or AdamW for each parameter; a fit that continues from a checkpoint ends with the same weights."""

import copy
import dataclasses
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.config.sections import OptimConfig
from icrl_dist.methods import registry as methods
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry as problems
from icrl_dist.training import fit, optimizers
from icrl_dist.training.batches import TrainingBatch
from icrl_dist.training.fit import Optimizer
from learner import checkpoints
from tests.jobs import InMemoryDataset, collect

CONFIG = OptimConfig(learning_rate=1e-2, batch=8, queries=4, weight_decay=0.1, beta2=0.9, warmup=2)


@pytest.fixture
def model(small_run):
    torch.manual_seed(0)
    return PretrainedTransformer(problems.of(small_run).spec, small_run.model)


@pytest.fixture
def batch(small_run: Run) -> Callable[[int], TrainingBatch]:
    """``batch(step)``: the training batch of a step, of a small DPT dataset."""
    optim = dataclasses.replace(small_run.optim, batch=CONFIG.batch, queries=CONFIG.queries)
    run = dataclasses.replace(small_run, method="dpt", optim=optim)
    method = methods.of(run)
    (phase,) = method.phases(run)
    draw = method.data(run, phase, InMemoryDataset(collect(run, phase)))
    return lambda step: draw(np.random.default_rng(step))


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_muon_updates_the_matrices_of_the_trunk_and_adamw_the_rest(model, batch, muon):
    other = copy.deepcopy(model)
    matrices = {n: p for n, p in other.named_parameters() if muon and n.startswith("trunk") and p.ndim == 2}
    rest = [p for n, p in other.named_parameters() if n not in matrices]
    assert len(matrices) == (8 if muon else 0)
    expected: list[torch.optim.Optimizer] = [torch.optim.AdamW(rest, lr=1e-3, weight_decay=0.1, betas=(0.9, 0.9))]
    if matrices:
        expected.append(torch.optim.Muon(matrices.values(), lr=1e-3 * muon, weight_decay=0.0))
    opt = Optimizer(model, dataclasses.replace(CONFIG, muon=muon))
    for step in range(3):
        for one in (model, other):
            batch_loss(one, batch(step)).backward()
        opt.step(1e-3)
        assert all(p.grad is None for p in model.parameters())
        for part in expected:
            part.step()
            part.zero_grad()
    for (name, mine), theirs in zip(model.named_parameters(), other.parameters(), strict=True):
        assert torch.equal(mine, theirs), name


def test_learning_imports_no_compiler(model, batch, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # importing it now fails
    opt = Optimizer(model, dataclasses.replace(CONFIG, muon=5.0))
    batch_loss(model, batch(0)).backward()
    opt.step(1e-3)
    opt.load(opt.state())
    optimizers.Adam([torch.zeros(1, requires_grad=True)], fused=True).step()
    with pytest.raises(ImportError):
        torch.optim.AdamW(model.parameters()).step()


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_a_fit_continued_from_a_checkpoint_ends_with_the_same_weights(small_run, model, batch, tmp_path, muon):
    config = dataclasses.replace(CONFIG, muon=muon)
    fresh, spec = copy.deepcopy(model), problems.of(small_run).spec

    def half(step, loss):
        if step == 5:
            checkpoints.save(
                tmp_path / "half.npz", checkpoints.weights(0, model), opt, checkpoints.manifest(small_run, spec, 0, 1)
            )

    opt = Optimizer(model, config)
    fit.fit(model, opt, config, 1e-2, 10, lambda step: batch_loss(model, batch(step)), half)
    again = Optimizer(fresh, config)
    checkpoints.restore(tmp_path / "half.npz", spec, fresh, again)
    fit.fit(fresh, again, config, 1e-2, 10, lambda step: batch_loss(fresh, batch(step)), first=5)
    for mine, theirs in zip(model.parameters(), fresh.parameters(), strict=True):
        assert torch.equal(mine, theirs)
    assert {k: v.tolist() for k, v in opt.state().items()} == {k: v.tolist() for k, v in again.state().items()}


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_a_checkpoint_of_the_other_optimizer_is_refused_in_one_line(small_run, model, batch, tmp_path, muon):
    one, other = (Optimizer(model, dataclasses.replace(CONFIG, muon=m)) for m in (muon, 5.0 - muon))
    batch_loss(model, batch(0)).backward()
    one.step(1e-3)
    spec = problems.of(small_run).spec
    checkpoints.save(tmp_path / "one.npz", checkpoints.weights(0, model), one, checkpoints.manifest(small_run, spec, 0, 1))
    with pytest.raises(ConfigError, match=r"another optimizer .*: use the optim.muon of its run"):
        checkpoints.restore(tmp_path / "one.npz", spec, model, other)
