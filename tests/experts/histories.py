"""A run of reacher whose SAC experts are trained on ten short episodes, and simulations that diverge."""

import dataclasses

import numpy as np
import pytest

from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.experts.sac import batched
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.stream import wire
from tests.calls import noting
from tests.jobs import in_problem

HORIZON, EPISODES = 20, 10


@pytest.fixture
def run(small_run, tmp_path):
    """Four tasks of reacher, a null and a pushing adversary in each, experts of ten short episodes."""
    sac = SACConfig(hidden=(8, 8), batch=16, random_steps=40, warmup=40, update_every=2, steps=HORIZON * EPISODES)
    return in_problem(
        small_run,
        "dmc-reacher-easy",
        method="icag",
        control=ControlConfig(train_tasks=4, test_tasks=2, horizon=HORIZON),
        adversary=AdversaryConfig(count=1),
        sac=dataclasses.replace(sac, cache=str(tmp_path / "experts")),
        pretrain=dataclasses.replace(small_run.pretrain, contexts=8 * 3, queries=6),
    )


@pytest.fixture
def trained(monkeypatch):
    """How many experts were trained each time."""
    batches = list[int]()
    monkeypatch.setattr(batched, "train", noting(batches, lambda env, *rest, **more: env.batch, batched.train))
    return batches


def digests(trajectories):
    return [wire.trajectory_digest(t) for t in trajectories]


class KilledError(Exception):
    pass


class Breaking:
    """A batch whose rows 1 and 3 diverge, in the first two episodes or in all."""

    def __init__(self, env, always):
        self.spec, self.batch, self._env, self._always, self._episode = env.spec, env.batch, env, always, -1

    def reset(self, rngs):
        self._episode += 1
        return self._env.reset(rngs)

    def step(self, actions):
        step = self._env.step(actions)
        broken = np.zeros(self.batch, bool)
        broken[[1, 3]] = self._always or self._episode < 2
        return step._replace(diverged=broken)
