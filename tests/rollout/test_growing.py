"""The growing deployment of Algorithm Distillation against a slow loop."""

from typing import Any

import numpy as np
import pytest

from icrl_dist.config.sections import ContextConfig
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
