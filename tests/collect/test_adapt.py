"""Rollouts of T^j: which decoder computes its decisions."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from icrl_dist.collect.adapt import Rollouts, rollouts
from icrl_dist.config.run import Run
from icrl_dist.config.sections import Decoder
from icrl_dist.methods import registry as methods
from icrl_dist.models.compiled import kinds
from icrl_dist.models.dpt import DeployedTransformer
from icrl_dist.models.kernel_transformer import KernelTransformer
from icrl_dist.problems import registry as problems

DECODERS: dict[Decoder, type] = {"torch": DeployedTransformer, "kernel": KernelTransformer}


@pytest.mark.parametrize("decoder", DECODERS)
@pytest.mark.parametrize("method", ["icaa", "icag"])
def test_a_job_acts_by_the_decoder_that_its_run_names(small_run: Run, method: str, decoder: Decoder) -> None:
    if decoder == "kernel" and not kinds():
        pytest.skip("the kernel was not built here")
    context, dagger = dataclasses.replace(small_run.context, decoder=decoder), dataclasses.replace(small_run.dagger, rounds=1)
    run = dataclasses.replace(small_run, method=method, context=context, dagger=dagger)
    owner, problem = methods.of(run), problems.of(run)
    weights = SimpleNamespace(at=lambda version: (owner.build(problem.spec, run).eval(), "digest"))
    phase = next(phase for phase in owner.phases(run) if phase.stage == "adapt")
    job = owner.ask(run, phase)[0]
    assert isinstance(job.payload, Rollouts)
    used = set()
    for _ in rollouts(job, problem, owner, weights, "w0", lambda policy, *_: used.add(type(policy._deployed))):
        pass
    assert used == {DECODERS[decoder]}
