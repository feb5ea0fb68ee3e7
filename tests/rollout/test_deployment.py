"""Algorithm 1 against a slow loop, and when transitions enter the context."""

from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.config.sections import ContextConfig, ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.models.sampling import sample
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room
from icrl_dist.rollout.deployment import InContextPolicy
from icrl_dist.rollout.episode import deploy_offline, deploy_online, episode
from icrl_dist.rollout.policies import RandomPolicy
from icrl_dist.types import Adversary, Variation

HORIZON = 6


@pytest.fixture
def variations():
    adversary = Adversary.of("uniform", p=0.3)
    return [Variation(room.task(goal, 3, HORIZON), adversary) for goal in ((0, 2), (1, 1), (2, 0))]


@pytest.fixture
def model(variations):
    torch.manual_seed(1)
    made = PretrainedTransformer(registry.spec(variations[0].task), ModelConfig(layers=2, width=16)).eval()
    for parameter in made.parameters():  # far from uniform, so that the context matters
        parameter.data *= 3
    return made


def rngs(trial, count=3):
    return [np.random.default_rng((trial, row)) for row in range(count)]


def logits_of(model, history, state):
    """T_theta at one state given a list of (s, a, s', r), which is encoded anew."""
    columns = list(zip(*history, strict=True)) if history else [np.zeros((0, 2))] * 4
    s, a, n, r = (np.array(c) for c in columns)
    context = Transitions(
        torch.tensor(s, dtype=torch.float32).reshape(1, -1, 2),
        torch.tensor(a, dtype=torch.long).reshape(1, -1),
        torch.tensor(n, dtype=torch.float32).reshape(1, -1, 2),
        torch.tensor(r, dtype=torch.float32).reshape(1, -1),
    )
    query = torch.tensor(state, dtype=torch.float32).reshape(1, 1, 2)
    with torch.no_grad():
        return model.decide(query, model.encode(context))[0, 0]


def algorithm_1(model, variation, row, trials, keep, most):
    """Lines 9 to 17 in one environment, step by step; ``keep`` and ``most`` as in the section ``[context]``."""
    env = registry.batch([variation])
    kept, returns = list[list[Any]](), []
    for trial in range(trials):
        rng = np.random.default_rng((trial, row))
        state = env.reset([rng])[0]
        u = rng.random(HORIZON)
        history = [t for past in kept for t in past]
        this, total = [], 0.0
        for h in range(HORIZON):
            p = logits_of(model, history, state).softmax(-1).double().numpy()
            action = int((u[h] * p.sum() >= p.cumsum()[:-1]).sum())
            step = env.step(np.array([action]))
            this.append((state, action, step.observation[0], step.reward[0]))
            state, total = step.observation[0], total + float(step.reward[0])
        kept = [this] if keep == "last" else [*kept, this]
        while sum(map(len, kept)) > most:
            kept.pop(0)
        returns.append((total, [t[1] for t in this]))
    return returns


@pytest.mark.parametrize(("keep", "most"), [("all", 1000), ("last", 1000), ("all", 2 * HORIZON + 1)])
def test_online_deployment_equals_algorithm_1(model, variations, keep, most):
    policy = InContextPolicy(model, 3, ContextConfig(max=most, keep=keep))
    ran = list(deploy_online(registry.batch(variations), policy, (rngs(n) for n in range(5))))
    for row, variation in enumerate(variations):
        slow = algorithm_1(model, variation, row, 5, keep, most)
        assert [r.actions[row].tolist() for r in ran] == [actions for _, actions in slow]
        assert [r.returns[row] for r in ran] == [total for total, _ in slow]
    assert policy.length == min({"all": 5, "last": 1}[keep], most // HORIZON) * HORIZON


def test_a_kept_cache_equals_a_fresh_one_also_after_an_episode_was_dropped(model, variations):
    policy = InContextPolicy(model, 3, ContextConfig(max=2 * HORIZON))
    history: list[list[Any]] = [[] for _ in variations]
    for n in range(4):
        ran = episode(registry.batch(variations), policy, rngs(n))
        for row in range(3):
            history[row].append(
                [
                    (ran.observations[row, h], ran.actions[row, h], ran.observations[row, h + 1], ran.rewards[row, h])
                    for h in range(HORIZON)
                ]
            )
            state = np.array([1.0, 2.0], np.float32)
            expected = logits_of(model, [t for past in history[row][-2:] for t in past], state).softmax(-1).numpy()
            np.testing.assert_allclose(policy.probabilities(np.tile(state, (3, 1)))[row], expected, atol=1e-5)


def test_the_context_is_frozen_within_an_episode(model, variations):
    policy = InContextPolicy(model, 3, ContextConfig(max=100))
    state = np.ones((3, 2), np.float32)
    before = policy.probabilities(state)
    moved = (state, np.zeros(3, np.int64), np.ones(3, np.float32), state)
    policy.observe(*moved, False)
    np.testing.assert_array_equal(policy.probabilities(state), before)
    policy.observe(*moved, True)
    assert np.abs(policy.probabilities(state) - before).max() > 1e-3
    assert policy.length == 2


def test_offline_deployment_has_the_given_data_and_nothing_else_in_its_context(model, variations):
    env = registry.batch(variations)
    data = episode(env, RandomPolicy(5), rngs(8))
    policy = InContextPolicy(model, 3, ContextConfig(max=100))
    ran = deploy_offline(env, policy, [data], rngs(9))
    history = [
        (data.observations[1, h], data.actions[1, h], data.observations[1, h + 1], data.rewards[1, h]) for h in range(HORIZON)
    ]
    single = registry.batch([variations[1]])
    rng = rngs(9)[1]
    state = single.reset([rng])[0]
    u = rng.random(HORIZON)
    for h in range(HORIZON):
        p = logits_of(model, history, state).softmax(-1).double().numpy()
        action = int((u[h] * p.sum() >= p.cumsum()[:-1]).sum())
        assert action == ran.actions[1, h]
        state = single.step(np.array([action])).observation[0]


def test_sampling_follows_the_probabilities():
    p = np.array([[0.1, 0.0, 0.6, 0.3]])
    u = (np.arange(1000) + 0.5) / 1000
    counts = np.bincount(sample(np.repeat(p, 1000, axis=0), u), minlength=4)
    assert counts.tolist() == [100, 0, 600, 300]
    assert sample(p, np.array([np.nextafter(1.0, 0.0)])) == 3


def test_changed_weights_change_the_actions(model, variations):
    def actions():
        policy = InContextPolicy(model, 3, ContextConfig(max=100))
        return np.stack([r.actions for r in deploy_online(registry.batch(variations), policy, (rngs(n) for n in range(3)))])

    acted = actions()
    for parameter in model.parameters():
        parameter.data.zero_()
    assert (actions() != acted).any()
