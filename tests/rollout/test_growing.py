"""The growing deployment of Algorithm Distillation against a slow loop."""

from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.config.sections import ContextConfig, ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.sampling import sample
from icrl_dist.problems import registry
from icrl_dist.rollout import deployment
from icrl_dist.rollout.deployment import GrowingPolicy, InContextPolicy
from icrl_dist.rollout.episode import deploy_offline, deploy_online, episode
from icrl_dist.rollout.policies import RandomPolicy
from tests.rollout.test_deployment import HORIZON, logits_of, model, rngs, variations

__all__ = ["model", "variations"]


def slow(model: Any, variation: Any, row: int, trials: int, most: int, given: list[Any]) -> list[list[int]]:
    """One environment, one step at a time: each decision encodes all transitions so far anew."""
    env, kept, acted = registry.batch([variation]), list(given), []
    for trial in range(trials):
        rng = np.random.default_rng((trial, row))
        state, u, this = env.reset([rng])[0], rng.random((HORIZON, 1)), list[Any]()
        kept.append(this)
        for h in range(HORIZON):
            logits = logits_of(model, [one for each in kept for one in each], state).double()
            action = int(sample(logits.softmax(-1).numpy()[None], u[h])[0])
            step = env.step(np.array([action]))
            this.append((state, action, step.observation[0], step.reward[0]))
            state = step.observation[0]
        while sum(map(len, kept)) > most:
            kept.pop(0)
        acted.append([one[1] for one in this])
    return acted


@pytest.mark.parametrize("decoder", ["torch", "auto"])
@pytest.mark.parametrize("most", [1000, 2 * HORIZON + 1])
def test_the_growing_deployment_equals_the_slow_loop(model, variations, most, decoder):
    policy = deployment.in_context(model, 3, ContextConfig(max=most, decoder=decoder), "growing")
    assert type(policy) is GrowingPolicy
    ran = [e.actions for e in deploy_online(registry.batch(variations), policy, map(rngs, range(4)))]
    expected = [slow(model, variation, row, 4, most, []) for row, variation in enumerate(variations)]
    assert np.array_equal(ran, np.array(expected).transpose(1, 0, 2))
    assert policy.length == min(4, most // HORIZON) * HORIZON


def test_episodes_of_other_policies_come_before_its_own(model, variations):
    env = registry.batch(variations)
    data = [episode(env, RandomPolicy(5), rngs(10 + n)) for n in range(2)]
    ran = deploy_offline(env, GrowingPolicy(model, 3, ContextConfig(max=1000)), data, rngs(0))
    for row, variation in enumerate(variations):
        given = [
            [(e.observations[row, h], e.actions[row, h], e.observations[row, h + 1], e.rewards[row, h]) for h in range(HORIZON)]
            for e in data
        ]
        assert ran.actions[row].tolist() == slow(model, variation, row, 1, 1000, given)[0]


@pytest.mark.parametrize("rule", ["growing", "committed"])
@pytest.mark.parametrize("decided", [True, False])
@pytest.mark.parametrize("most", [HORIZON, 3 * HORIZON])
def test_an_episode_that_is_appended_in_mid_episode_comes_before_the_running_one(variations, rule, decided, most):
    """Where it drops an older episode, the policy then has the context of one that never saw the dropped one."""
    torch.manual_seed(1)
    settings = ModelConfig(layers=2, width=16, window=3 if rule == "committed" else 1)
    model = PretrainedTransformer(registry.spec(variations[0].task), settings).eval()
    for parameter in model.parameters():
        parameter.data *= 3
    rng = np.random.default_rng(0)

    def made(count):
        states = rng.normal(size=(3, count + 1, 2)).astype(np.float32)
        actions, rewards = rng.integers(0, 5, (3, count)), rng.random((3, count)).astype(np.float32)
        return states[:, :-1], actions, states[:, 1:], rewards

    old, given, own = made(HORIZON), made(HORIZON), made(HORIZON)
    full, fresh = (deployment.in_context(model, 3, ContextConfig(max=most), rule) for _ in range(2))
    u = np.full((3, 1), 0.5)
    full.append(*old)
    if most > HORIZON:
        fresh.append(*old)
    for step in range(HORIZON):
        if step == 4:
            full.append(*given)
        now = [column[:, step] for column in own]
        if decided or step > 4:
            full.act(now[0], u)
        observed(full, now, step)
        if step == 3:
            fresh.append(*given)
            for before in range(4):
                observed(fresh, [column[:, before] for column in own], before)
        elif step > 3:
            observed(fresh, now, step)
            np.testing.assert_allclose(full.distribution(now[2][:1], 1), fresh.distribution(now[2][:1], 1), atol=1e-5)
    assert full.length == fresh.length == most


def observed(policy, transition, step):
    """Let a policy observe (s, a, s', r) of a step."""
    state, action, following, reward = transition
    policy.observe(state, action, reward, following, step == HORIZON - 1)


def test_every_transition_joins_the_context_at_once(model, variations):
    policy: InContextPolicy = GrowingPolicy(model, 3, ContextConfig())
    state = np.ones((3, 2), np.float32)
    for count in range(2 * HORIZON):
        assert len(policy.context(1)[1]) == count
        if count % 3:  # some transitions arrive without a decision in between
            expected = policy.distribution(state[:1], 1)
            np.testing.assert_allclose(policy.probabilities(state)[1], expected[0], atol=1e-6)
            assert policy.length == count
        done = count % HORIZON == HORIZON - 1
        policy.observe(state, np.full(3, count % 5), np.full(3, count % 2, np.float32), state, done)
    assert policy.length == 2 * HORIZON and policy.frozen(state) is None
