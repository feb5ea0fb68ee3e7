"""The replay of several experts."""

import pytest
import torch

from icrl_dist.experts.sac.draws import update_draws
from icrl_dist.experts.sac.replay import Replay


def test_the_replay_overwrites_the_oldest_and_each_expertdraws_its_own():
    replay = Replay(2, 4, 2, 1, torch.device("cpu"))
    with pytest.raises(IndexError, match="the replay is empty: add transitions first"):
        replay.take(torch.zeros(2, 1, dtype=torch.int64))
    for step in range(6):
        observation = torch.tensor([[step, 0.0], [step, 1.0]])
        replay.add(observation, observation[:, :1] / 10, observation[:, 0] * 2, observation + 1)
    assert (len(replay), replay.added) == (4, 6)
    ((picks, _),) = update_draws([0, 1], 0, (500, 1), 1, torch.device("cpu"))
    found = replay.take(picks)
    for expert in range(2):
        steps, own = found.observations[expert].T
        assert set(own.tolist()) == {float(expert)} and set(steps.tolist()) == {2.0, 3.0, 4.0, 5.0}
        assert torch.bincount(steps.long())[2:].min() > 80
        assert torch.equal(found.rewards[expert], steps * 2) and torch.equal(found.actions[expert, :, 0], steps / 10)
        assert torch.equal(found.next_observations[expert], found.observations[expert] + 1)
    assert not torch.equal(found.observations[0, :, 0], found.observations[1, :, 0]), "both experts drew the same transitions"
    again = Replay(2, 4, 2, 1, torch.device("cpu"))
    again.load(replay.state())
    for column, other in zip(found, again.take(picks), strict=True):
        assert torch.equal(column, other)
    with pytest.raises(ValueError, match="do not fit 2 experts of 5 transitions"):
        Replay(2, 5, 2, 1, torch.device("cpu")).load(replay.state())
