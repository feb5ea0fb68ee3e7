"""The training loop of experts: random steps, draws, time limits, diverged simulations, and a pole that is balanced."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from icrl_dist.experts.sac.batched import SACBatch, train
from icrl_dist.experts.sac.replay import Replay, ReplayBatch
from icrl_dist.experts.sac.stacked import outputs
from tests.calls import noting
from tests.experts.sac_cases import LINE, DivergingLine, Line


def test_the_target_bootstraps_through_the_time_limit():
    """The last transition of an episode has the observation at the limit, and its target includes the next value."""
    reported = []
    engine = train(Line(2), LINE, 14, [0, 1], lambda _, returns: reported.append(returns), "cpu")
    rows = torch.from_numpy(engine.replay.state()["rows"])
    assert rows.shape == (2, 14, 6) and rows[:, 6, 5].tolist() == [7, 7] and rows[:, 7, 1].tolist() == [0, 0]
    np.testing.assert_allclose(np.array(reported), rows[:, :, 3].reshape(2, 2, 7).sum(2).T, rtol=1e-5)
    last = rows[:, [6, 6, 13, 13]]
    batch = ReplayBatch(last[..., :2], last[..., 2:3], last[..., 3], last[..., 4:])
    noise = torch.randn(2, 2, 4, 1, generator=torch.Generator().manual_seed(0))
    before = {name: array.clone() for name, array in engine.arrays.items()}
    engine.arrays["critic/exp_avg"].zero_()
    engine.update(batch, noise)
    for expert in range(2):
        mean, log_deviation = outputs(
            engine.actor_shape, before["actor"][expert : expert + 1], batch.next_observations[expert : expert + 1]
        )[0].chunk(2, 1)
        u = mean + log_deviation.clamp(-20, 2).exp() * noise[1, expert]
        normal = torch.distributions.Normal(mean, log_deviation.clamp(-20, 2).exp())
        entropy = -(normal.log_prob(u) - (1 - u.tanh() ** 2 + 1e-6).log()).sum(1)
        inputs = torch.cat([batch.next_observations[expert], u.tanh()], dim=1).expand(2, -1, -1)
        next_value = outputs(engine.critic_shape, before["target"][expert], inputs)[..., 0].amin(0)
        next_value = next_value + before["log_temperature"][expert].exp() * entropy
        target = batch.rewards[expert] + 0.9 * next_value
        now = outputs(
            engine.critic_shape,
            before["critic"][expert],
            torch.cat([batch.observations, batch.actions], 2)[expert].expand(2, -1, -1),
        )
        error = (now[..., 0] - target).mean(1)  # the derivative by the last bias
        got = engine.critic_shape.layers(engine.arrays["critic/exp_avg"][expert])[-1][1][:, 0, 0] / 0.1
        torch.testing.assert_close(got, error, rtol=1e-3, atol=1e-5)


def test_actions_are_uniform_during_the_random_steps_then_the_experts(monkeypatch):
    steps = list[int]()
    monkeypatch.setattr(SACBatch, "act", noting(steps, lambda self, *arguments: self.steps, SACBatch.act))
    line = Line(400)
    train(line, LINE, 14, range(400), device="cpu")
    assert steps == list(range(5, 14))
    uniform = np.stack(line.actions_taken)[:5].ravel()
    assert np.abs(np.quantile(uniform, [0.1, 0.5, 0.9]) - [-0.8, 0.0, 0.8]).max() < 0.08


def test_training_depends_on_its_seeds_alone_and_continues_from_a_state():
    states = {}

    def save_state(engine, returns):
        states[engine.steps] = engine.state()

    line = Line(2)
    whole = train(line, LINE, 35, [5, 6], save_state, "cpu").state()
    assert whole["updates"] == 8  # after the steps 12, 15, ..., 33, not yet after 9
    assert len({tuple(start) for start in line.starts}) == 5 and len({x for start in line.starts for x in start}) == 10
    np.random.seed(1)
    torch.manual_seed(1)
    for again in (
        train(Line(2), LINE, 35, [5, 6], device="cpu"),
        train(Line(2), LINE, 35, [5, 6], device="cpu", state=states[14]),
    ):
        state = again.state()
        assert set(state) == set(whole)
        for name, array in whole.items():
            np.testing.assert_array_equal(state[name], array, err_msg=name)
    other = train(Line(2), LINE, 35, [6, 7], device="cpu").state()
    assert not np.array_equal(other["actor"], whole["actor"])
    cut = train(Line(2), LINE, 36, [5, 6], device="cpu").state()
    with pytest.raises(ValueError, match="step 36, within an episode of 7"):
        train(Line(2), LINE, 70, [5, 6], device="cpu", state=cut)


class UnreportedDivergence(DivergingLine):
    """Diverges without reporting it."""

    def step(self, actions):
        return super().step(actions)._replace(diverged=None)


def test_steps_of_a_diverged_simulation_are_left_out():
    engine = train(DivergingLine(2), LINE, 28, [0, 1], device="cpu")
    rows = engine.replay.state()["rows"]
    assert np.isfinite(rows).all() and engine.updates > 0
    assert rows[0, :7, 1].tolist() == [0, 1, 2, 3, 4, 5, 6] and rows[1, :8, 1].tolist() == [0, 1, 1, 1, 1, 1, 1, 0]
    first = Replay(1, 4, 2, 1, torch.device("cpu"))
    first.add(torch.ones(1, 2), torch.ones(1, 1), torch.ones(1), torch.ones(1, 2), torch.tensor([True]))
    assert not first.state()["rows"].any()


def test_nan_weights_stop_a_training():
    with pytest.raises(FloatingPointError, match=r"experts \[1\] .* step 12: lower the learning rates"):
        train(UnreportedDivergence(2), LINE, 28, [0, 1], device="cpu")
    with pytest.raises(ValueError, match="1 seeds for 2 environments"):
        train(Line(2), LINE, 28, [0], device="cpu")


def test_an_expert_learns_to_balance_the_pole_within_12000_steps():
    """Mean action, over ten evaluation episodes, every 1,000 steps."""
    ran = subprocess.run([sys.executable, "-m", "tests.experts.pole"], capture_output=True, text=True, timeout=550)
    returns = [float(line) for line in ran.stdout.splitlines()]
    assert ran.returncode == 0 and returns[-1] >= 190 and len(returns) <= 12, ran.stdout + ran.stderr
    assert returns[0] < 170, "the untrained expert is already good"
