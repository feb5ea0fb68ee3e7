"""The committed deployment (zeta of eq. 6) against a slow loop."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig
from icrl_dist.models.dpt import Transitions, Windows
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room
from icrl_dist.rollout import deployment
from icrl_dist.rollout.deployment import CommittedPolicy, InContextPolicy
from icrl_dist.rollout.episode import deploy_online
from icrl_dist.types import Adversary, Variation
from tests.models.windowed import HORIZON, LENGTH, B, build, trained


def outputs_of(model, history, zeta, state):
    """T_theta at a state after zeta, given a list of (s, a, s', r), which is encoded anew."""
    s, a, n, r = zip(*history, strict=True) if history else ([], [], [], [])
    seen = Transitions(
        torch.tensor(np.array(s, np.float32)).reshape(1, -1, 2),
        torch.tensor(np.array(a, np.int64)).reshape(1, -1),
        torch.tensor(np.array(n, np.float32)).reshape(1, -1, 2),
        torch.tensor(np.array(r, np.float32)).reshape(1, -1),
    )
    states = [z[0] for z in zeta] + [state]
    of = Windows(
        torch.tensor(np.array(states, np.float32))[None, None],
        torch.tensor([z[1] for z in zeta] + [0])[None, None],
        torch.tensor([float(z[2]) for z in zeta] + [0.0])[None, None],
    )
    with torch.no_grad():
        found = model.decide_windows(of, model.encode(seen), torch.tensor([[len(history)]]))
    return found[0, 0, -1].double().softmax(-1).numpy()


def slow(model, variation, row, trials, most):
    """The committed deployment in one environment, one step at a time."""
    env, kept, acted = registry.batch([variation]), list[list[Any]](), []
    for trial in range(trials):
        rng = np.random.default_rng((trial, row))
        state, u, this = env.reset([rng])[0], rng.random(HORIZON), list[Any]()
        for h in range(HORIZON):
            zeta = [(s, a, r) for s, a, _, r in this][-(LENGTH - 1) :]
            p = outputs_of(model, [*itertools.chain(*kept), *this], zeta, state)
            action = int((u[h] * p.sum() >= p.cumsum()[:-1]).sum())
            step = env.step(np.array([action]))
            this.append((state, action, step.observation[0], step.reward[0]))
            state = step.observation[0]
        acted.append([t[1] for t in this])
        kept.append(this)
        while sum(map(len, kept)) > most:
            kept.pop(0)
    return acted


def variations():
    adversary = Adversary.of("uniform", p=0.3)
    return [Variation(room.task(goal, 5, HORIZON), adversary) for goal in ((0, 2), (1, 1), (4, 0))]


@pytest.mark.parametrize("most", [1000, 2 * HORIZON + 1])
def test_the_committed_deployment_equals_the_slow_loop(most):
    model, rows = build(), variations()
    policy = CommittedPolicy(model, B, ContextConfig(max=most))
    rngs = ([np.random.default_rng((trial, row)) for row in range(B)] for trial in range(4))
    ran = [e.actions for e in deploy_online(registry.batch(rows), policy, rngs)]
    expected = [slow(model, variation, row, 4, most) for row, variation in enumerate(rows)]
    assert np.array_equal(ran, np.array(expected).transpose(1, 0, 2))
    assert policy.length == min(4, most // HORIZON) * HORIZON


def test_every_transition_joins_the_context_at_once_and_a_decision_changes_nothing():
    model = build()
    state, step = np.ones((B, 2), np.float32), np.zeros(B, np.int64)
    asked, silent = (CommittedPolicy(model, B, ContextConfig()) for _ in range(2))
    for count in range(HORIZON):
        for _ in range(2):
            expected = asked.probabilities(state)
            assert asked.length == count
        if count in (3, 5):
            np.testing.assert_allclose(silent.probabilities(state), expected, atol=1e-6)
        for policy in (asked, silent):
            policy.observe(state, step + count % 5, np.full(B, count % 2, np.float32), state, count == HORIZON - 1)
    assert asked.length == silent.length == HORIZON
    np.testing.assert_allclose(silent.probabilities(state), asked.probabilities(state), atol=1e-6)


def test_a_model_without_windows_is_not_committed():
    with pytest.raises(ConfigError, match=r"model\.window = 1") as caught:
        InContextAgent(trained(build(window=1)), {}, deploy="committed")
    assert "\n" not in str(caught.value)
    kinds = {1: InContextPolicy, LENGTH: CommittedPolicy}
    for window, kind in kinds.items():
        assert type(deployment.in_context(build(window=window), 1, ContextConfig())) is kind
        agent = InContextAgent(trained(build(window=window)), {})
        assert (agent.deploy, type(agent._policy)) == ("paper" if window == 1 else "committed", kind)
    assert type(deployment.in_context(build(), 1, ContextConfig(), "paper")) is InContextPolicy
