"""Labels from a model's own trials: each kind against a slow loop, and rooms where the best action is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run, load_run
from icrl_dist.methods import own_labels
from icrl_dist.methods import registry as methods
from icrl_dist.methods.examples import self_labelled
from icrl_dist.problems import registry as problems
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.rollout.episode import deploy_online
from icrl_dist.rollout.policies import Exploring, RandomPolicy
from icrl_dist.training import batches
from icrl_dist.types import Adversary, Identity, Trajectory, Variation
from tests.jobs import FixedWeights, InMemoryDataset, do, jobs_of
from tests.methods.conftest import Collected, PoolsOf

State = tuple[float, ...]


def steps(trial: Trajectory) -> list[tuple[State, int, float, State]]:
    """(s, a, r, s') of every step."""
    states = [tuple(map(float, o)) for o in trial.observations]
    return [(states[h], int(trial.actions[h]), float(trial.rewards[h]), states[h + 1]) for h in range(len(trial.actions))]


def slow_returns(trials: Sequence[Trajectory], gamma: float, left_out: int) -> dict[State, dict[int, float]]:
    """Mean discounted return-to-go of each action at each state."""
    found: dict[State, dict[int, list[float]]] = {}
    for trial in trials:
        rewards = [r for _, _, r, _ in steps(trial)]
        for h, (s, a, _, _) in enumerate(steps(trial)[: len(rewards) - left_out]):
            to_go = sum(gamma**k * r for k, r in enumerate(rewards[h:]))
            found.setdefault(s, {}).setdefault(a, []).append(to_go)
    return {s: {a: float(np.mean(values)) for a, values in by_action.items()} for s, by_action in found.items()}


def slow_transitions(trials: Sequence[Trajectory], gamma: float) -> dict[State, dict[int, float]]:
    """Values of H + 1 steps in the room whose transitions are those that were counted."""
    seen: dict[tuple[State, int], list[tuple[float, State]]] = {}
    for trial in trials:
        for s, a, r, after in steps(trial):
            seen.setdefault((s, a), []).append((r, after))
    value: dict[State, float] = {}
    for _ in range(len(trials[0].actions) + 1):
        q: dict[State, dict[int, float]] = {}
        for (s, a), outcomes in seen.items():
            q.setdefault(s, {})[a] = sum(r + gamma * value.get(after, 0.0) for r, after in outcomes) / len(outcomes)
        value = {s: max(by_action.values()) for s, by_action in q.items()}
    return q


def slow_labels(q: dict[State, dict[int, float]], slack: float) -> dict[State, list[float]]:
    """A uniform label over the nearly best actions of every state where a reward can follow."""
    labels = {}
    for s, by_action in q.items():
        best = max(by_action.values())
        if best > 1e-6:
            good = [by_action.get(a, -1.0) >= best * (1 - slack) - 1e-9 for a in range(5)]
            labels[s] = [one / sum(good) for one in good]
    return labels


def check(found: own_labels.Labels | None, expected: dict[State, list[float]]) -> None:
    """Every expected state once, with its label."""
    assert found is not None
    assert sorted(map(tuple, found[0].tolist())) == sorted(expected)
    for state, label in zip(*found, strict=True):
        np.testing.assert_allclose(label, expected[tuple(map(float, state))], atol=1e-6)


def walks(run: Run, adversary: Adversary, count: int) -> list[Trajectory]:
    """``count`` random walks from the origin under this adversary, in the first training task."""
    job = jobs_of(run, "icaa", 1)[0]
    task = job.variations[0].task
    job = dataclasses.replace(job, variations=(Variation(task, adversary),), tasks=1, trials=count)
    made = do(run, job, FixedWeights(run))
    env, policy = problems.of(run).batch(job.variations), RandomPolicy(5)
    rngs = [[np.random.default_rng([n])] for n in range(count)]
    ran = deploy_online(env, policy, rngs)
    return [
        dataclasses.replace(t, observations=e.observations[0], actions=e.actions[0], rewards=e.rewards[0])
        for t, e in zip(made, ran, strict=True)
    ]


@pytest.mark.parametrize("slack", [0.0, 0.03, 0.5])
@pytest.mark.parametrize("adversary", [Adversary.of("null"), Adversary.of("uniform", p=0.4)])
def test_labels_of_transitions_are_those_of_a_slow_loop(small_run: Run, adversary: Adversary, slack: float) -> None:
    trials = walks(small_run, adversary, 30)
    expected = slow_labels(slow_transitions(trials, 0.9), slack)
    check(own_labels.of_transitions(trials, 0.9, slack), expected)
    assert len(expected) > 3


@pytest.mark.parametrize(("gamma", "left_out"), [(0.5, 2), (0.8, 5), (0.99, 7)])
def test_labels_of_returns_are_those_of_a_slow_loop(small_run: Run, gamma: float, left_out: int) -> None:
    """With gamma = 0.99 100 steps would be left out, so only the first of the 8 steps is used."""
    trials = walks(small_run, Adversary.of("uniform", p=0.2), 40)
    expected = slow_labels(slow_returns(trials, gamma, left_out), 0.1)
    check(own_labels.of_returns(trials, gamma, 0.1), expected)


@pytest.mark.parametrize("of", [own_labels.of_returns, own_labels.of_transitions])
def test_trials_without_a_reward_give_no_labels(
    small_run: Run, of: Callable[[Sequence[Trajectory], float, float], own_labels.Labels | None]
) -> None:
    trials = [dataclasses.replace(t, rewards=0 * t.rewards) for t in walks(small_run, Adversary.of("null"), 4)]
    assert of(trials, 0.9, 0.03) is None


@pytest.mark.parametrize(
    "adversary",
    [Adversary.of("wind", p=1.0, direction=0), Adversary.of("permuted", p=1.0, permutation=(2, 3, 1, 0, 4))],
    ids=lambda a: a.kind,
)
def test_labels_of_transitions_are_optimal_where_the_undisturbed_actions_are_not(small_run: Run, adversary: Adversary) -> None:
    """Random walks long enough to have taken every action in every state that they reach."""
    trials = walks(small_run, adversary, 150)
    found = own_labels.of_transitions(trials, 0.9, 1e-6)
    assert found is not None
    queries, labels = found
    hypotheses = [
        Hypotheses.of([dataclasses.replace(trials[0].variation, adversary=a)]) for a in (adversary, Adversary.of("null"))
    ]
    best, undisturbed = (soft_labels(h, 0.99, 0.0)[0][cell_numbers(queries, 3)] for h in hypotheses)
    assert ((labels > 0) <= (best > 0)).all()
    assert ((labels > 0) & (undisturbed == 0)).any(axis=1).mean() > 0.2


@pytest.mark.parametrize("labels", ["returns", "transitions"])
def test_contexts_are_trials_0_to_n_and_every_trial_is_compared(
    small_run: Run, labels: Literal["returns", "transitions"]
) -> None:
    """The first trial that finds the goal is the last one: its states have labels all the same, and it is no context."""
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, labels=labels, label_gamma=0.5))
    trials = walks(run, Adversary.of("null"), 5)
    trials = [dataclasses.replace(t, rewards=np.full_like(t.rewards, n == 4)) for n, t in enumerate(trials)]
    made = self_labelled(run, trials)
    assert made is not None
    np.testing.assert_array_equal(made.actions, np.stack([t.actions for t in trials[:2]]))
    used = 6 if labels == "returns" else 8
    visited = {tuple(s) for s in trials[4].observations[:used].tolist()}
    assert visited <= {tuple(s) for s in made.queries.tolist()}
    assert len({tuple(s) for s in made.queries.tolist()}) == len(made.queries), "each state has one label"


def test_contexts_of_any_trials_are_up_to_n_plus_1_of_all_in_any_order(
    small_run: Run, collected: Collected, pools_of: PoolsOf
) -> None:
    icaa = dataclasses.replace(small_run.icaa, labels="transitions", context="any", context_trials=2)
    run = dataclasses.replace(small_run, icaa=icaa)
    numbered = [dataclasses.replace(t, rewards=0 * t.rewards + n) for n, t in enumerate(collected.trajectories)]
    method, data = methods.of(run), InMemoryDataset(numbered)
    _, own = pools_of(method, run, method.phases(run)[1], data)
    orders, counts = set(), set()
    for seed in range(60):
        batch = batches.draw(np.random.default_rng(seed), [own], 4, 4)
        for row in batch.rewards.reshape(len(batch.rewards), -1, 8)[..., 0]:
            found = [(numbered[int(n)].identity[:4], numbered[int(n)].identity.trial) for n in row]
            assert len(set(found)) == len(found) and len({key for key, _ in found}) == 1, "different trials of one variation"
            orders.add(tuple(n for _, n in found))
            counts.add(len(found))
    assert counts == {1, 2, 3} and {n for order in orders for n in order} == set(range(5))
    assert any(list(order) != sorted(order) for order in orders)


def test_label_quality_rates_the_labels_that_compare_actions(small_run: Run, collected: Collected) -> None:
    run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, labels="transitions"))
    method, data = methods.of(run), InMemoryDataset(collected.trajectories)
    exact = problems.of(run).exact
    assert exact is not None
    for rated in method.label_quality(run, method.phases(run)[1], data):
        found = own_labels.of_transitions(rated.trials, run.icaa.label_gamma, run.icaa.label_slack)
        assert (rated.agreement is None) == (found is None)
        if found is not None:
            assert rated.agreement == exact.optimal(rated.trials[0].variation, *found).mean()


class Counting:
    """Acts by the uniform number, and remembers what it observes."""

    def __init__(self) -> None:
        self.numbers: list[np.ndarray] = []
        self.observed: list[np.ndarray] = []

    def act(self, observation: np.ndarray, u: np.ndarray) -> np.ndarray:
        self.numbers.append(u[:, 0])
        return np.full(len(u), 4)

    def observe(self, observation: np.ndarray, action: np.ndarray, *others: object) -> None:
        self.observed.append(action)


def test_exploring_begins_after_the_context_trials_and_draws_uniform_actions() -> None:
    inner = Counting()
    policy = Exploring(inner, 5, 0.25, 1)
    state, u = np.zeros((4000, 2), np.float32), np.random.default_rng(0).random((2, 4000, 1))
    for episode in range(2):
        action = policy.act(state, u[episode])
        policy.observe(state, action, np.zeros(4000, np.float32), state, True)
    assert (inner.observed[0] == 4).all() and (inner.numbers[0] == u[0, :, 0]).all(), "T^j alone acts in the first episode"
    random = u[1, :, 0] < 0.25
    assert (inner.observed[1][~random] == 4).all()
    counts = np.bincount(inner.observed[1][random], minlength=5)
    assert len(counts) == 5 and (abs(counts / random.sum() - 0.2) < 0.05).all()
    own = inner.numbers[1][~random]
    assert 0 <= own.min() < 0.01 and 0.99 < own.max() < 1 and abs(own.mean() - 0.5) < 0.03, "still uniform in [0, 1)"


def test_explored_trials_differ_only_after_the_contexts(small_run: Run) -> None:
    made = []
    for share in (0.0, 0.9):
        run = dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, explore=share))
        made.append(do(run, jobs_of(run, "icaa", 1)[0], FixedWeights(run)))
    same: dict[bool, list[bool]] = {True: [], False: []}
    for one, two in zip(*made, strict=True):
        identity: Identity = one.identity
        assert identity == two.identity
        same[identity.trial <= small_run.icaa.context_trials].append(bool((one.actions == two.actions).all()))
    assert all(same[True]) and not all(same[False])


@pytest.mark.parametrize(
    ("icaa", "model", "key"),
    [
        ({"labels": "returns", "label_trials": "improved"}, {}, "icaa.label_trials"),
        ({"labels": "transitions"}, {"window": 2}, "icaa.labels"),
        ({"context": "any"}, {}, "icaa.context"),
    ],
)
def test_labels_that_do_not_fit_are_refused(small_run: Run, icaa: dict[str, Any], model: dict[str, int], key: str) -> None:
    run = dataclasses.replace(
        small_run, icaa=dataclasses.replace(small_run.icaa, **icaa), model=dataclasses.replace(small_run.model, **model)
    )
    found = list(methods.of(run).objections(run))
    assert [where for where, _, _ in found] == [key]
    assert not list(methods.of(small_run).objections(small_run))


def test_continuous_actions_cannot_be_compared_or_explored() -> None:
    for key, value in (("labels", "returns"), ("explore", 0.1)):
        with pytest.raises(ConfigError, match=rf"icaa\.{key}"):
            load_run("dmc-cartpole-balance-laptop", "method=icaa", f"icaa.{key}={value}")
