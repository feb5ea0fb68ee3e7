"""The posterior that a model's distributions imply, against a slow search; reading it changes nothing."""

import time
from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.agent.loading import load_agent
from icrl_dist.config.sections import ContextConfig, ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import posterior
from icrl_dist.problems.darkroom.exact_agents import ExactAgent
from icrl_dist.problems.darkroom.posterior import RoomPosterior, by_goal, exact, hypotheses, implied
from icrl_dist.problems.darkroom.room import cells
from icrl_dist.problems.darkroom.solver import soft_labels
from icrl_dist.rollout.deployment import in_context
from icrl_dist.rollout.episode import episode
from icrl_dist.rollout.policies import RandomPolicy
from icrl_dist.types import NULL, Adversary, Spec, Variation

UNIFORM = Adversary.of("uniform", p=0.3)


def policies(size, adversaries):
    h = hypotheses(size, 10 * size, adversaries)
    return h, soft_labels(h, 0.99, 0.1)


def slow(target, policies, rounds=3000):
    """Expectation maximization cell by cell and action by action, from uniform weights."""
    count = len(policies)
    weight = [1 / count] * count
    for _ in range(rounds):
        new = [0.0] * count
        for s in range(len(target)):
            for a in range(target.shape[1]):
                mix = sum(weight[m] * policies[m, s, a] for m in range(count))
                for m in range(count):
                    if mix > 0:
                        new[m] += target[s, a] * weight[m] * policies[m, s, a] / mix
        weight = [w / sum(new) for w in new]
    return weight


def divergence(target, mix):
    return sum(t * np.log(t / m) for t, m in zip(target.ravel(), mix.ravel(), strict=True) if t > 0 and m > 0) / len(target)


def test_the_implied_mixture_is_the_nearest_one_of_a_slow_search():
    _, basis = policies(3, [UNIFORM])
    rng = np.random.default_rng(0)
    basis = basis[[0, 4, 8, 5]].astype(np.float64)
    targets = 0.7 * np.einsum("bm,mca->bca", rng.dirichlet(np.ones(4), 2), basis) + 0.3 * rng.dirichlet(np.ones(5), (2, 9))
    found = implied(targets, basis)
    for target, weight, distance, gap in zip(targets, *found, strict=True):
        best = slow(target, basis, 60)
        supported = np.where(basis.any(axis=0), target, 0)
        least = divergence(supported, np.einsum("m,mca->ca", best, basis))
        assert distance == pytest.approx(divergence(supported, np.einsum("m,mca->ca", weight, basis)), abs=1e-9)
        assert least - 1e-4 <= distance <= least + gap + 1e-9 and gap < posterior.TOLERANCE
        np.testing.assert_allclose(weight, best, atol=0.05)


@pytest.mark.parametrize("adversary", [NULL, UNIFORM])
@pytest.mark.parametrize("kind", ["even", "sparse", "certain", "half"])
def test_a_known_mixture_is_found_again(adversary, kind):
    _, basis = policies(10, [adversary])
    rng = np.random.default_rng(3)
    weight = {
        "even": rng.dirichlet(np.ones(100)),
        "sparse": rng.dirichlet(np.full(100, 0.05)),
        "certain": np.eye(100)[37],
        "half": np.repeat([0.0, 0.02], 50),
    }[kind]
    found = implied(np.einsum("m,mca->ca", weight, basis.astype(np.float64))[None], basis)
    assert np.abs(found.weight[0] - weight).sum() / 2 < 1e-3
    assert found.divergence[0] < 1e-3


def test_rows_of_a_batch_are_independent():
    _, basis = policies(4, [UNIFORM])
    targets = np.random.default_rng(1).dirichlet(np.ones(5), (3, 16))
    together = implied(targets, basis)
    for row, target in enumerate(targets):
        single = implied(target[None], basis)
        assert np.abs(together.weight[row] - single.weight[0]).sum() < 0.05
        assert together.divergence[row] == pytest.approx(single.divergence[0], abs=posterior.TOLERANCE)


def test_a_hundred_goals_take_milliseconds():
    _, basis = policies(10, [NULL])
    rng = np.random.default_rng(0)
    target = 0.9 * np.einsum("m,mca->ca", rng.dirichlet(np.full(100, 0.1)), basis) + 0.1 * rng.dirichlet(np.ones(5), 100)
    times = []
    for _ in range(5):
        began = time.process_time()
        implied(target[None], basis)
        times.append(time.process_time() - began)
    assert min(times) < 0.05  # about 3 ms on an idle machine


class Seen:
    """An exact agent with ``distribution`` at any state and ``context``."""

    def __init__(self, agent, columns):
        self._agent, self._columns = agent, columns

    def distribution(self, states, row=0):
        return np.concatenate([self._agent.probabilities(state[None]) for state in states])

    def context(self, row=0):
        return self._columns


@pytest.mark.parametrize("adversary", [NULL, UNIFORM])
def test_the_exact_agents_distribution_implies_the_exact_posterior(adversary, room):
    """Its distribution is the mixture by the exact posterior (Theorem E.3)."""
    size, horizon = 6, 30
    goal = room(size, horizon)[22].replace(start=(0, 0))
    h, labels = policies(size, [adversary])
    agent = ExactAgent([h], [labels], np.array([0]), "every step")
    ran = episode(registry.batch([Variation(goal, adversary)]), RandomPolicy(5), [np.random.default_rng(2)])
    columns = ran.observations[0, :-1], ran.actions[0].astype(np.int64), ran.observations[0, 1:], ran.rewards[0]
    for length in (0, 7, horizon):
        for t in range(length) if length else ():
            one = [column[t : t + 1] for column in columns]
            agent.observe(one[0], one[1], one[3], one[2], False)
        read = RoomPosterior(size, 10 * size, [adversary], 0.99, 0.1).read(Seen(agent, [c[:length] for c in columns]))
        assert np.abs(read.implied - read.exact).sum() / 2 < 1e-3
        assert read.transitions == length and read.exact.sum() == pytest.approx(1)
        refuted = {tuple(cell) for cell, r in zip(columns[2][:length].tolist(), columns[3], strict=False) if not r}
        assert [tuple(c) in refuted for c in cells(size).tolist()] == (read.exact == 0).tolist()
        agent = ExactAgent([h], [labels], np.array([0]), "every step")


def test_adversaries_are_summed_over():
    h, labels = policies(5, [NULL, UNIFORM])
    weight = np.random.default_rng(0).dirichlet(np.ones(50))
    assert by_goal(h, weight) == pytest.approx(weight.reshape(25, 2).sum(axis=1))
    target = np.einsum("m,mca->ca", weight, labels.astype(np.float64))
    assert by_goal(h, implied(target[None], labels).weight[0]) == pytest.approx(weight.reshape(25, 2).sum(axis=1), abs=0.02)


def test_a_context_that_no_goal_explains_is_refused():
    h = hypotheses(3, 5, [NULL])
    states = np.array([[0, 0], [1, 0], [0, 0]], np.float32)
    once, never = np.array([1.0, 0.0], np.float32), np.array([1.0, 1.0], np.float32)
    assert exact(h, (states[:2], np.array([0, 1]), states[1:], once)).argmax() == 3
    with pytest.raises(ValueError, match="probability 0"):
        exact(h, (states[:2], np.array([0, 1]), states[1:], never))


def build(window, heads=2):
    """A model in which every parameter has an effect."""
    torch.manual_seed(0)
    spec = Spec(low=(0.0, 0.0), high=(4.0, 4.0), actions=5, horizon=7)
    model = PretrainedTransformer(spec, ModelConfig(3, heads, 16, window=window)).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.4)
    return model


def deployed(deploy, ask, keep="all", length=3):
    """Everything that a policy did in some episodes; ``ask`` is called between its calls."""
    model = build(4)
    policy = in_context(model, 2, ContextConfig(max=16, keep=keep), deploy)
    rng, acted, states = np.random.default_rng(0), [], np.zeros((2, 2), np.float32)
    for step in range(7 * length):
        ask(policy, model)
        action = policy.act(states, rng.random((2, 1)))
        ask(policy, model)
        after = rng.integers(0, 5, (2, 2)).astype(np.float32)
        policy.observe(states, action, rng.integers(0, 2, 2).astype(np.float32), after, step % 7 == 6)
        acted += [action, policy.probabilities(after)] if step % 7 < 6 else [action]
        states = after
    return [a.tobytes() for a in acted]


@pytest.mark.parametrize("deploy", ["paper", "committed"])
@pytest.mark.parametrize("keep", ["all", "last"])
def test_the_distribution_at_any_state_is_the_models_given_the_context_and_reading_it_changes_nothing(deploy, keep):
    asked, lengths = list[Any](), []
    grid = cells(5)

    @torch.inference_mode()
    def ask(policy, model):
        row = len(asked) // 2 % 2
        found, columns = policy.distribution(grid, row), policy.context(row)
        context = Transitions(*(torch.from_numpy(column)[None] for column in columns))
        logits = model.decide(torch.from_numpy(grid)[None], model.encode(context))
        np.testing.assert_allclose(found, logits[0].softmax(-1).numpy(), atol=2e-5)
        asked.append(found)
        lengths.append(len(columns[1]))

    quiet = deployed(deploy, lambda policy, model: None, keep)
    assert deployed(deploy, ask, keep) == quiet
    assert np.ptp(np.stack(asked), axis=(0, 1)).min() > 1e-3, "all distributions are alike, so this would prove nothing"
    assert max(lengths) == {"all": {"paper": 14, "committed": 20}, "last": {"paper": 7, "committed": 13}}[keep][deploy]


def test_reading_the_shipped_agents_distribution_changes_nothing():
    """Not even its later draws."""

    def play(ask):
        agent, rng = load_agent("darkroom", seed=3), np.random.default_rng(1)
        state, acted = [0.0, 0.0], []
        for _ in range(40):
            (action,) = agent.act([state])
            after = rng.integers(0, 10, 2).tolist()
            agent.observe([state], [action], [0.0], [after], [False])
            ask(agent)
            state = after
            acted.append(int(action))
        return acted, agent.surprise.tobytes()

    assert play(lambda agent: agent.distribution(cells(10))) == play(lambda agent: None)
