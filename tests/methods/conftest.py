"""Fixtures of the tests of methods."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import pytest

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw, Method, Phase, TrajectoryDataset
from icrl_dist.methods import examples
from icrl_dist.methods import registry as methods
from icrl_dist.training.batches import Pool
from icrl_dist.types import Trajectory
from tests.jobs import FixedWeights, collect

PoolsOf = Callable[[Method, Run, Phase, TrajectoryDataset], Sequence[Pool]]


class Collected(NamedTuple):
    """The trajectories of all phases of an ICAA run, and the weights that acted."""

    trajectories: list[Trajectory]
    weights: FixedWeights


@pytest.fixture
def collected(small_run: Run) -> Collected:
    """All trajectories of ``small_run``, which is an ICAA run, with an untrained model."""
    weights = FixedWeights(small_run)
    phases = methods.of(small_run).phases(small_run)
    return Collected([t for phase in phases for t in collect(small_run, phase, weights)], weights)


@pytest.fixture
def pools_of(monkeypatch: pytest.MonkeyPatch) -> PoolsOf:
    """``pools_of(method, run, phase, dataset)``: the pools that the method draws the batches of a phase from."""

    def pools(method: Method, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Sequence[Pool]:
        found: list[Sequence[Pool]] = []
        original = examples.draw

        def record(run: Run, pools: Sequence[Pool]) -> Draw:
            found.append(pools)
            return original(run, pools)

        with monkeypatch.context() as patch:
            patch.setattr(examples, "draw", record)
            method.data(run, phase, dataset)
        (only,) = found
        return only

    return pools


@pytest.fixture
def icag_run(small_run: Run) -> Run:
    """``small_run`` with the method ICAG."""
    return dataclasses.replace(small_run, method="icag")
