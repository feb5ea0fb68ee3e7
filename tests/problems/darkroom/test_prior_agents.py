"""The exact agents with a prior over goals and adversaries, against enumeration over all pairs, and their returns."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from icrl_dist.config.run import Run, override
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.models.sampling import sample
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom import solver
from icrl_dist.problems.darkroom.adversaries import Disturbance, grid
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.problems.darkroom.prior_agents import LEVELS, Prior, PriorAgent, PriorRule, dpt_prior, icag_prior
from icrl_dist.problems.darkroom.room import ACTIONS, DarkRoom
from icrl_dist.problems.darkroom.solver import Hypotheses
from icrl_dist.results import evaluate
from icrl_dist.results.evaluate import Agent
from icrl_dist.types import NULL, Adversary, Variation
from tests.problems.darkroom.test_exact_agents import likelihood
from tests.problems.darkroom.test_solver import DISTURBED, normalized

SIZE, HORIZON = 3, 7
WEIGHTS = {NULL: 0.5, DISTURBED[0]: 0.2, DISTURBED[1]: 0.2, Adversary.of("uniform", p=0.5): 0.1}
Transition = tuple[tuple[int, int], int, float, tuple[int, int]]


def room(kind: Disturbance = "wind") -> DarkRoomConfig:
    return DarkRoomConfig(size=SIZE, horizon=HORIZON, disturbance=kind)


@pytest.mark.parametrize("rule", ["paper", "committed"])
def test_the_distribution_is_that_of_drawn_goals_and_adversaries(rule: PriorRule) -> None:
    """Enumeration over all pairs of goal and adversary, at every step of three episodes in three rows."""
    tasks = [darkroom.task(divmod(cell, SIZE), SIZE, HORIZON) for cell in range(SIZE**2)]
    pairs = [[Variation(task, adversary) for adversary in WEIGHTS] for task in tasks]
    labels = np.stack([solver.soft_labels(Hypotheses.of(group), 0.99, 0.1) for group in pairs])  # (G, J, C, A)
    truths = [pairs[5][1], pairs[2][2], pairs[6][0]]
    agent, env = PriorAgent(Prior.of(room(), WEIGHTS), 3, rule), DarkRoom(truths)
    generators = [np.random.default_rng(60 + row) for row in range(3)]
    histories: list[list[Transition]] = [[], [], []]
    kept = [[1 / len(tasks)] * len(tasks) for _ in range(3)]
    """Committed: the distribution of the goal that is kept."""

    def beliefs(history: list[Transition]) -> tuple[list[float], list[float]]:
        joint = [
            [w * math.prod(likelihood(v, one) for one in history) for v, w in zip(group, WEIGHTS.values(), strict=True)]
            for group in pairs
        ]
        return normalized([sum(row) for row in joint]), normalized([sum(column) for column in zip(*joint, strict=True)])

    moved, refuted = 0.0, 0
    for _ in range(3):
        observation = env.reset(generators)
        begun = [len(history) for history in histories]
        for _ in range(HORIZON):
            found, slow = agent.probabilities(observation), np.zeros((3, ACTIONS))
            frozen = agent.frozen(observation)
            assert (frozen is None) == (rule == "committed")
            if frozen is not None:
                np.testing.assert_allclose(frozen[range(3), range(3)], found)
            cells = solver.cell_numbers(observation, SIZE)
            for row, history in enumerate(histories):
                goal, adversary = beliefs(history[: begun[row]] if rule == "paper" else history)
                goal = kept[row] if rule == "committed" else goal
                slow[row] = np.einsum("g,j,gja->a", goal, adversary, labels[:, :, cells[row]])
                moved = max(moved, float(np.abs(slow[row] - labels[:, 0, cells[row]].mean(axis=0)).max()))
            np.testing.assert_allclose(found, slow, atol=1e-6)
            action = sample(found, np.array([rng.random() for rng in generators]))
            step = env.step(action)
            for row, history in enumerate(histories):
                _, before = beliefs(history)
                here, there = ((int(o[row, 0]), int(o[row, 1])) for o in (observation, step.observation))
                history.append((here, int(action[row]), float(step.reward[row]), there))
                if rule == "paper":
                    continue
                right = np.einsum("j,gj->g", before, labels[:, :, cells[row], action[row]])
                agreed = normalized([k * float(r) for k, r in zip(kept[row], right, strict=True)])
                out = [(there == t["goal"]) != (history[-1][2] > 0) for t in tasks]
                left = [0.0 if gone else k for k, gone in zip(agreed, out, strict=True)]
                refuted += sum(left) < 0.99
                fresh, _ = beliefs(history)
                kept[row] = [k + (1 - sum(left)) * f for k, f in zip(left, fresh, strict=True)]
            agent.observe(observation, action, step.reward, step.observation, step.done)
            observation = step.observation
    assert moved > 0.3 and (refuted > 5 or rule == "paper")
    assert any(one[2] == 1.0 for history in histories for one in history)


@pytest.mark.parametrize("rule", ["paper", "committed"])
@pytest.mark.parametrize("kind", ["override", "wind", "permuted"])
def test_no_transition_makes_an_agent_fail(rule: PriorRule, kind: Disturbance) -> None:
    """Moves that no adversary of the prior makes, rewards at two goals and actions that the agent never takes."""
    priors = [dpt_prior(room(kind)), icag_prior(room(kind), AdversaryConfig(count=8, p_max=0.2))]
    rng = np.random.default_rng(0)
    for prior in priors:
        agent = PriorAgent(prior, 4, rule)
        for t in range(60):
            before, after = (rng.integers(0, SIZE, size=(4, 2)).astype(np.float32) for _ in range(2))
            agent.observe(before, rng.integers(0, ACTIONS, 4), (rng.random(4) < 0.3).astype(np.float32), after, t % 7 == 6)
            probabilities = agent.probabilities(after)
            assert np.isfinite(probabilities).all() and (probabilities >= 0).all()
            np.testing.assert_allclose(probabilities.sum(axis=1), 1.0, rtol=1e-5)


def test_dpts_agent_learns_the_goal_from_rewards_alone() -> None:
    """In a wind, an agent that found the goal goes there by the undisturbed optimum; ICAG's presses against the wind."""
    agents = [PriorAgent(prior, 1, "paper") for prior in (dpt_prior(room()), icag_prior(room(), AdversaryConfig(8, p_max=1.0)))]
    at = [np.array([[x, 1.0]], np.float32) for x in range(3)]
    for agent in agents:  # the agent stays, a wind in direction +x moves it; the goal is (1, 1)
        data = [(at[0], 1.0, at[1]), (at[1], 0.0, at[2]), *[(at[2], 0.0, at[2])] * 3] * 4
        columns = [np.stack([one[i] for one in data], axis=1) for i in (0, 2)]
        agent.append(columns[0], np.full((1, 20), 4), columns[1], np.array([[one[1] for one in data]], np.float32))
    dpt, icag = (agent.probabilities(at[1])[0] for agent in agents)
    np.testing.assert_allclose(dpt, [0, 0, 0, 0, 1], atol=1e-6)
    assert icag[1] > 0.95, "in the goal cell, action -x and then the wind +x stay there"


def test_phi_0_has_its_share_of_the_prior() -> None:
    for count, p_max, adversaries in ((4, 0.6, 33), (0, 0.6, 1), (4, 0.0, 5)):
        prior = icag_prior(room(), AdversaryConfig(count=count, p_max=p_max))
        assert len(prior.log_weight) == adversaries and np.exp(prior.log_weight).sum() == pytest.approx(1)
        assert np.exp(prior.log_weight[0]) == pytest.approx(1 / (count + 1))
    without = icag_prior(room(), AdversaryConfig(count=4, null=False, p_max=0.6))
    np.testing.assert_allclose(np.exp(without.log_weight), 1 / 32)
    assert len(grid("permuted", ACTIONS, 1.0, 5)) == 35 and len(grid("override", ACTIONS, 1.0, 8)) == 32
    assert all(a.number("p") != 0.5 for kind, levels in LEVELS.items() for a in grid(kind, ACTIONS, 1.0, levels))
    assert grid("override", ACTIONS, 1.0, 8) == grid("override", ACTIONS, 1.0, 8)


@pytest.mark.parametrize("kind", ["override", "wind", "permuted"])
def test_returns_lie_between_random_and_oracle_and_the_right_prior_wins(small_run: Run, kind: Disturbance) -> None:
    """A 5x5 room at p = 0.6: the paper's thesis with exact agents, where the disturbance must be inferred."""
    settings = [f"darkroom.disturbance={kind}", "darkroom.size=5", "darkroom.horizon=20", "adversary.p_max=1.0"]
    settings += ["adversary.count=8", "evaluate.p=[0.6]", "evaluate.episodes=12", "evaluate.seeds=8"]
    run = override(dataclasses.replace(small_run, method="icag"), settings, "test")
    references = registry.of(run).references(run)
    keys = ("random", "exact:dpt", "exact:dpt-committed", "exact:icag", "exact:icag-committed", "oracle")
    found = evaluate.online(run, {Agent(key): references[key] for key in keys})
    mean = {one.agent.key: float(one.returns[:, :, -4:].mean()) for one in found}
    for key in keys[1:-1]:
        assert mean["random"] + 0.5 < mean[key] < mean["oracle"] + 0.3, mean
    if kind != "override":
        assert mean["exact:icag"] > mean["exact:dpt"] + 1, mean
        assert mean["exact:icag-committed"] > mean["exact:dpt-committed"] + 1, mean
