"""The evaluation and the agent, held against what is known exactly."""

import dataclasses

import numpy as np
import pytest
import torch

from icrl_dist import InContextAgent, evaluate, make
from icrl_dist.agent import load_agent
from icrl_dist.config import ConfigError, ContextConfig
from icrl_dist.envs import spec, tasks
from icrl_dist.files import StoreError
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.oracle import Hypotheses, optimal_returns
from icrl_dist.stats import mean_and_error


@pytest.fixture
def model(small_run):
    torch.manual_seed(0)
    return PretrainedTransformer(spec(tasks.split(small_run).train[0]), small_run.model).eval()


def test_the_oracle_reaches_the_exact_optimum_and_nobody_passes_it(small_run, model):
    run = dataclasses.replace(small_run, evaluate=dataclasses.replace(small_run.evaluate, seeds=60, p=(0.0, 0.4)))
    agents = {"model": evaluate.in_context(run, model), "random": evaluate.random, evaluate.ORACLE: evaluate.optimal(run)}
    for result in evaluate.online(run, agents):
        assert result.returns.shape == (len(tasks.split(run).test), 60, 3)
        error = result.returns.mean(axis=(0, 2)).std() / np.sqrt(60)
        if result.agent == evaluate.ORACLE:
            assert abs(result.returns.mean() - result.optimum.mean()) < 4 * error + 0.05
        else:
            assert result.returns.mean() < result.optimum.mean() - 4 * error


def test_all_agents_meet_the_same_chance(small_run, model):
    agents = {"one": evaluate.in_context(small_run, model), "two": evaluate.in_context(small_run, model)}
    one, two, *_ = evaluate.online(small_run, agents)
    np.testing.assert_array_equal(one.returns, two.returns)


def test_held_out_variations_start_in_the_origin_and_never_trained(small_run):
    chosen = evaluate.variations(small_run, 0.2)
    assert [v.task.vector("goal") for v in chosen] == [t.vector("goal") for t in tasks.split(small_run).test]
    assert all(v.task.vector("start") == (0, 0) and v.adversary.number("p") == 0.2 for v in chosen)


def test_rows_are_tidy(small_run):
    result = evaluate.Result("x", 0.2, np.arange(12.0).reshape(2, 2, 3), np.array([10.0, 12.0]))
    row = result.row()
    assert row["episodes"] == [4.5, 5.5, 6.5] and row["optimum"] == 11.0
    assert row["last5_over_optimum"] == round(5.5 / 11, 4)
    mean, error = mean_and_error(result.returns)
    np.testing.assert_allclose(error, np.full(3, np.std([3, 6], ddof=1) / np.sqrt(2)))
    np.testing.assert_allclose(mean, [4.5, 5.5, 6.5])


def test_offline_rows_hold_random_and_expert_data(small_run, model):
    rows = evaluate.offline(small_run, {"T": model})
    assert [r.agent for r in rows[:4]] == ["random data", "T, random data", "expert data", "T, expert data"]
    expert = next(r for r in rows if r.agent == "expert data" and r.p == 0)
    np.testing.assert_allclose(expert.returns.mean(axis=(1, 2)), expert.optimum)


def test_the_agent_acts_as_the_policy_under_it_and_forgets_on_reset(small_run, model):
    env = make(evaluate.variations(small_run, 0.0)[0])
    agent = InContextAgent(model, {}, ContextConfig(max=100), seed=3)

    def play(episodes):
        actions = []
        for n in range(episodes):
            obs, _ = env.reset(seed=n)
            done = False
            while not done:
                (action,) = agent.act(obs[None])
                following, reward, _, done, _ = env.step(action)
                agent.observe(obs[None], np.array([action]), np.array([reward]), following[None], np.array([done]))
                obs = following
                actions.append(int(action))
        return actions

    agent._rng = np.random.default_rng(3)
    first = play(2)
    grown = agent.act(np.zeros((1, 2), np.float32))
    agent.reset_context(batch=1)
    agent._rng = np.random.default_rng(3)
    assert play(2) == first
    assert grown.shape == (1,)


def test_the_agent_names_wrong_shapes(model):
    agent = InContextAgent(model, {}, ContextConfig(max=100))
    agent.reset_context(batch=3)
    with pytest.raises(ValueError, match=r"obs has shape \(2, 2\), expected \(3, 2\)"):
        agent.act(np.zeros((2, 2), np.float32))
    good = (np.zeros((3, 2)), np.zeros(3, int), np.zeros(3), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="end together"):
        agent.observe(*good, np.array([True, False, True]))
    with pytest.raises(ValueError, match=r"reward has shape"):
        agent.observe(*good[:2], np.zeros(2), good[3], np.zeros(3, bool))


def test_loading_nothing_and_garbage_is_told_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match="no such run folder or checkpoint"):
        load_agent(tmp_path / "nothing")
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(ConfigError, match="holds no checkpoint yet"):
        load_agent(tmp_path)
    (tmp_path / "checkpoints" / "version-0000.npz").write_bytes(b"garbage")
    with pytest.raises(StoreError, match="not a checkpoint"):
        load_agent(tmp_path)


def test_the_exact_optimum_beside_a_result_is_the_variations_own(small_run):
    (result, *_) = evaluate.online(small_run, {"random": evaluate.random})
    np.testing.assert_allclose(result.optimum, optimal_returns(Hypotheses.of(evaluate.variations(small_run, 0.0))))
