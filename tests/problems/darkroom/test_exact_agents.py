"""The exact agents against the distribution of an agent that draws its hypotheses, by summing over all draws."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from icrl_dist.models.sampling import sample
from icrl_dist.problems.darkroom import exact_agents, solver
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom.exact_agents import RULES, WINDOW, ExactAgent, OptimalAgent, Rule
from icrl_dist.problems.darkroom.room import ACTIONS, DarkRoom
from icrl_dist.problems.darkroom.solver import Hypotheses
from icrl_dist.types import NULL, Adversary, Task, Variation
from tests.problems.darkroom.test_solver import ADVERSARIES, ALPHA, normalized, outcomes

SIZE, HORIZON, EPISODES = 3, WINDOW + 2, 3
OTHERS = (Adversary.of("uniform", p=0.5), Adversary.of("dirichlet", p=0.2, alpha=ALPHA[::-1]))
Room = Callable[[int, int], tuple[Task, ...]]
Transition = tuple[tuple[int, int], int, float, tuple[int, int]]
Family = tuple[Variation, ...]


@pytest.fixture
def families(room: Room) -> tuple[Family, Family]:
    """Every goal of a 3x3 room under two adversaries; and under two others."""

    def under(two: Sequence[Adversary]) -> Family:
        return tuple(Variation(t, a) for t in room(SIZE, HORIZON) for a in two)

    return under(ADVERSARIES), under(OTHERS)


def labels_of(family: Family) -> np.ndarray:
    return solver.soft_labels(Hypotheses.of(family), 0.99, 0.1)


def likelihood(variation: Variation, one: Transition) -> float:
    cell, action, reward, arrived = one
    probability = sum(p for p, there in outcomes(variation, cell, action) if there == arrived)
    return probability * (reward == (1.0 if arrived == variation.task["goal"] else 0.0))


def slow_distribution(rule: Rule, family: Family, labels: np.ndarray, history: list[Transition], query: int) -> np.ndarray:
    """Distribution of the action in cell ``query`` after ``history``, by enumeration of all draws of hypotheses."""

    @functools.cache
    def posterior(t: int) -> list[float]:
        return normalized([math.prod(likelihood(v, one) for one in history[:t]) for v in family])

    def draws(t: int) -> list[float]:
        return posterior(t - t % HORIZON if rule == "paper" else t)

    def drops(t: int, m: int) -> bool:
        """Whether the hypothesis that acted at step t is drawn again for the next step."""
        if rule == "committed":
            return likelihood(family[m], history[t]) == 0.0
        if rule == "windows":
            return (t + 1) % HORIZON in (0, WINDOW)
        return True

    @functools.cache
    def from_here(t: int, m: int) -> np.ndarray:
        """P(the agent's actions from step t on, and each action in the end | m acts at t)."""
        if t == len(history):
            return labels[m, query].astype(float)
        (x, y), action, _, _ = history[t]
        probability = float(labels[m, x * SIZE + y, action])
        if probability == 0.0:
            return np.zeros(ACTIONS)
        if not drops(t, m):
            return probability * from_here(t + 1, m)
        following = (w * from_here(t + 1, other) for other, w in enumerate(draws(t + 1)))
        return probability * sum(following, np.zeros(ACTIONS))

    if rule == "zeta":
        return given_zeta(posterior(len(history)), labels, history, query)
    joint = sum(w * from_here(0, m) for m, w in enumerate(draws(0)))
    return np.array(joint) / np.sum(joint)


def given_zeta(weight: list[float], labels: np.ndarray, history: list[Transition], query: int) -> np.ndarray:
    """The distribution given that as many as possible of the episode's last steps were optimal, up to ``exact_agents.ZETA``."""
    recent = history[len(history) - len(history) % HORIZON :][-exact_agents.ZETA :]
    for first in range(len(recent) + 1):
        agreed = [
            w * math.prod(float(labels[m, x * SIZE + y, action]) for (x, y), action, _, _ in recent[first:])
            for m, w in enumerate(weight)
        ]
        if sum(agreed) > 0:
            return np.array(normalized(agreed)) @ labels[:, query].astype(float)
    raise AssertionError


@pytest.mark.parametrize("rule", RULES)
def test_the_distribution_of_every_rule_is_that_of_drawn_hypotheses(
    families: tuple[Family, Family], rule: Rule, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows with different adversaries, all steps of three episodes; the goal is reached, hypotheses are refuted."""
    monkeypatch.setattr(exact_agents, "ZETA", 4)
    truths = [families[0][11], families[1][6], families[0][4]]
    family = np.array([0, 1, 0])
    labels = [labels_of(f) for f in families]
    agent = ExactAgent([Hypotheses.of(f) for f in families], labels, family, rule)
    env, rngs = DarkRoom(truths), [np.random.default_rng(40 + row) for row in range(3)]
    histories: list[list[Transition]] = [[], [], []]
    moved = 0.0
    for _ in range(EPISODES):
        observation = env.reset(rngs)
        for _ in range(HORIZON):
            found = agent.probabilities(observation)
            for row, history in enumerate(histories):
                x, y = (int(c) for c in observation[row])
                slow = slow_distribution(rule, families[family[row]], labels[family[row]], history, x * SIZE + y)
                np.testing.assert_allclose(found[row], slow, atol=1e-9)
                moved = max(moved, float(np.abs(found[row] - labels[family[row]][:, x * SIZE + y].mean(axis=0)).max()))
            action = sample(found, np.array([rng.random() for rng in rngs]))
            step = env.step(action)
            agent.observe(observation, action, step.reward, step.observation, step.done)
            for row, history in enumerate(histories):
                here, there = ((int(o[row, 0]), int(o[row, 1])) for o in (observation, step.observation))
                history.append((here, int(action[row]), float(step.reward[row]), there))
            observation = step.observation
    assert moved > 0.3, "the distribution hardly changed, so the test would pass for an agent that ignores its observations"
    assert any(one[2] == 1.0 for history in histories for one in history)


def test_the_rules_differ(families: tuple[Family, Family]) -> None:
    h, labels = Hypotheses.of(families[0]), labels_of(families[0])
    agents = {rule: ExactAgent([h], [labels], np.array([0]), rule) for rule in RULES}
    origin = np.zeros((1, 2), np.float32)
    for _ in range(3):
        for agent in agents.values():
            agent.observe(origin, np.array([0]), np.zeros(1, np.float32), origin, False)
    query = np.array([[1.0, 1.0]], np.float32)
    found = [agent.probabilities(query)[0].round(9).tolist() for agent in agents.values()]
    assert len({tuple(one) for one in found}) == len(RULES), found


def test_given_data_count_at_once_and_a_kept_hypothesis_is_dropped(families: tuple[Family, Family]) -> None:
    h, labels = Hypotheses.of(families[0]), labels_of(families[0])
    env, rng = DarkRoom([families[0][7]]), np.random.default_rng(1)
    states, actions, rewards = [env.reset([rng])], [], []
    for _ in range(HORIZON):
        actions.append(rng.integers(ACTIONS, size=1))
        step = env.step(actions[-1])
        states.append(step.observation)
        rewards.append(step.reward)
    places = [(int(s[0, 0]), int(s[0, 1])) for s in states]
    history = list(zip(places, (int(a[0]) for a in actions), (float(r[0]) for r in rewards), places[1:], strict=False))
    belief = normalized([math.prod(likelihood(v, one) for one in history) for v in families[0]])
    given = [np.stack(column, axis=1) for column in (states[:-1], actions, states[1:], rewards)]
    query = np.array([[0.0, 2.0]], np.float32)
    for rule in RULES:
        agent = ExactAgent([h], [labels], np.array([0]), rule)
        agent.append(*given)
        expected = sum(w * labels[m, 2].astype(float) for m, w in enumerate(belief))
        np.testing.assert_allclose(agent.probabilities(query)[0], expected, rtol=1e-9)


def test_an_agent_that_keeps_a_hypothesis_refuses_actions_that_none_would_take(room: Room) -> None:
    h = Hypotheses.of([Variation(room(2, 4)[3])])
    labels = solver.soft_labels(h, 0.99, 0.1)
    for rule in RULES:
        agent = ExactAgent([h], [labels], np.array([0]), rule)
        away = (np.array([[0.0, 1.0]], np.float32), np.array([3]), np.zeros(1, np.float32), np.zeros((1, 2), np.float32), False)
        if rule in ("windows", "committed"):
            with pytest.raises(ValueError, match="an action that the exact agent never takes"):
                agent.observe(*away)
        else:
            agent.observe(*away)


def test_the_optimal_agent_reaches_the_optimal_return() -> None:
    """Solver against simulation: p, q, walls, horizon and start must agree in both."""
    rows, horizon = 2000, 15
    adversaries = (NULL, Adversary.of("uniform", p=0.5), Adversary.of("dirichlet", p=0.4, alpha=ALPHA))
    kinds = [
        Variation(darkroom.task(g, 4, horizon, (0, 0)), a) for g, a in zip([(3, 1), (2, 2), (1, 3)], adversaries, strict=True)
    ]
    h = Hypotheses.of(kinds)
    promised = solver.optimal_returns(h)
    labels = solver.soft_labels(h, 1.0, 0.0)
    room = DarkRoom([v for v in kinds for _ in range(rows)])
    agent = OptimalAgent(np.repeat(labels, rows, axis=0), 4)
    rng = np.random.default_rng(0)
    observation = room.reset([np.random.default_rng(seed) for seed in range(3 * rows)])
    total = np.zeros(3 * rows)
    for _ in range(horizon):
        edges = agent.probabilities(observation).cumsum(axis=1)
        step = room.step(np.minimum((rng.random((3 * rows, 1)) >= edges).sum(axis=1), ACTIONS - 1))
        observation, total = step.observation, total + step.reward
    earned = total.reshape(3, rows)
    error = earned.std(axis=1, ddof=1) / math.sqrt(rows)
    assert earned[0].std() == 0
    assert (np.abs(earned.mean(axis=1) - promised) <= 4 * error + 1e-9).all(), (earned.mean(axis=1), promised, error)
