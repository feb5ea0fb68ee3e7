"""The memory of a worker that trains experts, against the arrays themselves, and what is said about it."""

import dataclasses

import numpy as np
import pytest
import torch

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import memory
from icrl_dist.experts.sac.batched import SACBatch
from icrl_dist.experts.sac.replay import Replay
from icrl_dist.problems.dmc import domains
from icrl_dist.types import Spec
from tests.experts.sac_cases import SMALL, SPEC, N

TEN = SACConfig(replay=200_000)
"""The paper's width, 3x256, with 200,000 steps of replay."""


def test_the_parts_are_those_of_the_arrays():
    batch = SACBatch(range(N), SPEC, SMALL, "cpu")
    found = memory.needed(N, SPEC, dataclasses.replace(SMALL, cache=""), 1)
    assert found.replay == batch.replay._rows.nbytes
    assert memory.needed(N, SPEC, SMALL, 1).replay == 2 * found.replay, "and the copy in a checkpoint of the training"
    held = sum(array.nbytes for name, array in batch.arrays.items() if "temperature" not in name)
    held += 4 * N * (batch.actor_shape.parameters + 2 * batch.critic_shape.parameters)  # gradients
    assert held <= found.networks * 1.05 and found.networks < 2 * held
    few = dataclasses.replace(SMALL, steps=SPEC.horizon, replay=10_000, cache="")
    assert memory.needed(N, SPEC, few, 1).replay == found.replay * SPEC.horizon / SMALL.replay, "a short training fills less"


@pytest.mark.parametrize("kind", domains.PROBLEMS)
def test_ten_experts_of_the_papers_width_stay_under_four_gigabytes(kind):
    spec = domains.spec(domains.task(kind))
    assert memory.needed(10, spec, TEN, 100).total < 4e9
    text = memory.described(10, spec, TEN, 100)
    assert text.startswith("a worker trains up to 10 SAC experts of 3x256 at once and needs about ") and ";" not in text


def test_more_than_four_gigabytes_come_with_the_settings_that_need_less():
    spec = Spec((-1.0,) * 17, (1.0,) * 17, 6, 200, discrete=False)
    text = memory.described(160, spec, dataclasses.replace(TEN, hidden=(256, 64)), 100)
    assert " 160 SAC experts of 256x64 at once and needs about 14.5 GB of memory, 10.5 GB of it for replays; smaller " in text
    assert "stream.job_tasks, sac.replay, or fewer --actors need less" in text


def test_a_loaded_replay_needs_no_second_copy():
    before, after = (Replay(2, 50, 3, 1, torch.device("cpu")) for _ in range(2))
    before._rows.normal_()
    before.added = 60
    state = before.state()
    state["rows"].flags.writeable = False  # as of an array that a reader gave
    after.load(state)
    np.testing.assert_array_equal(after.state()["rows"], before.state()["rows"])
    assert after.added == 60
