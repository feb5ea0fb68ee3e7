"""The suite ``attack`` and the column ``certified``, against slow loops in a 3x3 room."""

from __future__ import annotations

import copy
import dataclasses
import json

import numpy as np
import pytest

import icrl_dist
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import EvaluateConfig
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom.adversaries import override_distribution
from icrl_dist.problems.darkroom.room import cells
from icrl_dist.problems.darkroom.solver import expected_returns, worst_case, worst_cases
from icrl_dist.results import attack, evaluate, heldout
from icrl_dist.results.evaluate import Agent, Rows
from icrl_dist.results.tables import returns_table
from icrl_dist.rollout.episode import episode
from tests.optional import known
from tests.problems.darkroom.test_worst_case import MOVES, moved, random_policy, variation
from tests.results.row_blocks import frame, rendered, unwrapped
from tests.results.test_evaluate import folder, references, untrained

__all__ = ["folder", "untrained"]

CERTIFIABLE = ["random", "exact:paper", "exact:dpt", "exact:icag", "oracle"]


def with_evaluation(run, **settings):
    return dataclasses.replace(run, evaluate=EvaluateConfig(**settings))


def test_many_policies_at_once_have_the_worst_case_of_each():
    rng = np.random.default_rng(0)
    policies = np.stack([random_policy(rng, 9) for _ in range(5)])
    goals, starts = [(0, 1), (2, 2), (1, 0), (2, 0), (1, 1)], [(0, 0), None, (2, 1), None, (1, 1)]
    tasks = [variation(goal, 3, 7, start) for goal, start in zip(goals, starts, strict=True)]
    for p in (0.0, 0.3, 1.0):
        alone = [worst_case(policy, one, p) for policy, one in zip(policies, tasks, strict=True)]
        np.testing.assert_allclose(worst_cases(policies, tasks, p), alone, rtol=0, atol=1e-12)
        shared = [worst_case(policies[2], one, p) for one in tasks]
        np.testing.assert_allclose(worst_cases(policies[2:3], tasks, p), shared, rtol=0, atol=1e-12)
        np.testing.assert_allclose(worst_cases(None, tasks, p), [worst_case(None, one, p) for one in tasks], atol=1e-12)


def slow_expected(policy, one):
    """Expected return in a variation, by loops over steps, cells and actions."""
    size, horizon = int(one.task.number("size")), int(one.task.number("horizon"))
    goal, (p, q) = one.task.vector("goal"), override_distribution(one.adversary, len(MOVES))
    at = int(goal[0]) * size + int(goal[1])
    value = [0.0] * size**2
    for _ in range(horizon):
        arrived = [[float(moved(c, a, size) == at) + value[moved(c, a, size)] for a in range(5)] for c in range(size**2)]
        value = [sum(((1 - p) * policy[c, a] + p * q[a]) * arrived[c][a] for a in range(5)) for c in range(size**2)]
    return value[0]


def contexts(run, agent, p):
    """Before each episode, the policy of the agent in every row: a copy with its context."""
    problem, rows = registry.of(run), Rows.of(run, p)
    env = problem.batch(rows.flat)
    policy, found = agent(rows.flat, env), []
    for n in range(run.evaluate.episodes):
        found.append(copy.deepcopy(policy))
        episode(env, policy, [i._replace(trial=n).rng(run.seed) for i in rows.ids])
    return rows, found


@pytest.mark.parametrize("key", ["t0", "exact:paper"])
def test_the_suite_equals_slow_loops(small_run, untrained, key):
    run = with_evaluation(small_run, episodes=3, seeds=2, p=(0.3,))
    make = evaluate.in_context(untrained, run.context, "paper") if key == "t0" else references(run)[key].make
    agent = Agent(key, "paper" if key == "t0" else "")
    made = frame(*attack.blocks(run, {agent: make}, 3, "run"), suite="attack")
    rows, policies = contexts(run, make, 0.3)
    for number in (0, 1, 2):
        policy = policies[number]
        by_row = []
        for row in range(len(rows.flat)):
            laws = np.zeros((9, 5))
            for cell in range(9):
                observation = np.tile(cells(3)[cell], (len(rows.flat), 1))
                laws[cell] = copy.deepcopy(policy).probabilities(observation)[row]
            by_row.append(laws)
        here = made[(made.agent == key) & (made.episode == number)]
        assert len(here) == 5 * len(rows.flat)
        for one in here.to_dict("records"):
            row = one["task_index"] * 2 + one["evaluation_seed"]
            task = rows.flat[row].task
            wanted = registry.test_adversary(run, one["task_index"], 0.3, one["prior"] or "uniform", one["adversary_index"])
            against = icrl_dist.Variation(task, wanted if one["prior"] else icrl_dist.NULL)
            assert one["adversary_family"] == against.adversary.kind
            assert one["return"] == pytest.approx(slow_expected(by_row[row], against), abs=1e-5)
            assert one["certified"] == pytest.approx(worst_case(by_row[row], against, 0.3), abs=1e-5)
            assert one["certified"] <= one["return"] <= one["optimum"] + 1e-9
    for one in made[made.agent == "minimax"].to_dict("records"):
        task = rows.variations[one["task_index"]][0]
        assert one["return"] == one["certified"] == pytest.approx(worst_case(None, task, 0.3))
    for entry in attack.summary(made):
        own = made[(made.agent == key) & (made.episode == entry["episode"] - 1)]
        tasks = [own[own.task_index == i] for i in (0, 1)]
        sampled = [[of[(of.prior == "unseen") & (of.adversary_index == k)]["return"].mean() for k in range(3)] for of in tasks]
        for name, values in (
            ("nominal", [of[of.prior == ""]["return"].mean() for of in tasks]),
            ("uniform", [of[of.prior == "uniform"]["return"].mean() for of in tasks]),
            ("sampled", [sum(one) / 3 for one in sampled]),
            ("worst_sampled", [min(one) for one in sampled]),
            ("certified", [of["certified"].mean() for of in tasks]),
        ):
            assert entry[name] == pytest.approx([sum(values) / 2, min(values)], abs=1e-3)
        assert entry["certified"][0] <= entry["worst_sampled"][0] <= entry["sampled"][0] + 1e-9


def test_the_expected_return_is_the_mean_of_many_episodes(small_run):
    run = with_evaluation(small_run, episodes=1, seeds=400, p=(0.4,), prior="uniform")
    (result,) = evaluate.online(run, {Agent("random"): references(run)["random"]})
    rows = Rows.of(run, 0.4)
    expected = expected_returns(np.full((1, 9, 5), 0.2), rows.flat).reshape(2, 400)
    difference = (result.returns[:, :, 0] - expected).mean(axis=1)
    assert (np.abs(difference) < 4 * result.returns[:, :, 0].std(axis=1) / 20).all()


def test_agents_that_are_fixed_within_an_episode_have_a_certified_return_and_others_an_estimate(small_run, untrained):
    run = with_evaluation(small_run, episodes=7, seeds=2, p=(0.0, 0.4), prior="uniform")
    agents = {Agent(key): one for key, one in references(run).items()}
    agents[Agent("t0", "paper")] = evaluate.in_context(untrained, run.context, "paper")
    found = evaluate.online(run, agents)
    for one in found:
        certified = one.extra["certified"]
        has = one.agent.key in [*CERTIFIABLE, "t0"]
        assert np.isnan(certified[:, :, :2]).all() and np.isnan(certified[:, :, 2:]).all() == (not has), "only the last 5"
        if has:
            assert (certified[:, :, 2:] <= known(one.optimum)[:, :, None] + 1e-9).all()
        if one.agent.key == "oracle" and one.p == 0:
            np.testing.assert_allclose(certified[:, :, -1], known(one.optimum))
    text = rendered(returns_table(frame(*(one.block(run, "run", "evaluated") for one in found)), ""))
    assert text.count("estimated") == 1 + 6, "at p = 0.4 all evaluations are under the uniform adversary, which is no worst one"
    assert "against the worst adversary that overrides actions with probability p (exact" in unwrapped(text)


@pytest.mark.integration
def test_the_command_prints_one_table_and_stores_its_rows(folder, capsys):
    words = ["evaluate", str(folder), "--suite", "attack", "--p", "0.2", "--seeds", "2", "--draws", "2", "--json"]
    assert main.main([*words, "--episodes", "6"]) == 0
    printed = capsys.readouterr()
    answer = json.loads(printed.out.splitlines()[-1])
    assert answer["suite"] == "attack" and answer["draws"] == 2
    assert [(one["key"], one["episode"]) for one in answer["attack"]] == [
        (key, number) for key in ("t0", *CERTIFIABLE) for number in (1, 2, 5, 6)
    ]
    assert "It certifies one episode given its context" in unwrapped(printed.err)
    assert "says nothing about other training seeds" in unwrapped(printed.err)
    stored = icrl_dist.read_results(folder)
    assert set(stored.suite) == {"attack"} and set(stored.prior) == {"", "uniform", "unseen"}
    assert list((folder / "report").glob("attack-*-2draws.json"))


def test_for_a_context_that_grows_within_the_episode_the_worst_sampled_adversary_is_an_estimate(small_run):
    run = with_evaluation(small_run, episodes=2, seeds=2, p=(0.3,))
    growing = references(run)["exact:every-step"]
    left_out = attack.blocks(run, {Agent("exact:every-step"): growing}, 2, "run")
    assert {str(block["agent"]) for block in left_out} == {"minimax"}
    made = frame(*attack.blocks(run, {Agent("t0", "committed"): growing.make}, 2, "run"), suite="attack")
    found = attack.summary(made)
    assert all(entry["certified"] is None for entry in found)
    own = made[made.agent == "t0"]
    assert (own["return"] == own["return"].round()).all(), "one episode each, so whole returns"
    text = rendered(attack.table(run, found, "", 2))
    assert f"{found[0]['worst_sampled'][0]:.1f} / {found[0]['worst_sampled'][1]:.1f} estimated" in text


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"p": [0.0, 0.2]}, "--suite attack: at p = 0 there is no adversary; name strengths above 0, as in --p 0.2 0.4"),
        ({"draws": 0}, "--draws 0: at least 1 sampled adversary is needed"),
    ],
)
def test_impossible_attacks_are_refused_in_one_line(folder, options, expected):
    with pytest.raises(ConfigError) as refused:
        icrl_dist.evaluate(folder, suite="attack", **options)
    assert str(refused.value) == expected


def test_a_problem_without_certificates_is_told_what_to_use(toy_run):
    run = toy_run()
    with pytest.raises(ConfigError, match=r"--suite attack: .* has no exact worst case; use --suite online --prior unseen"):
        heldout.check_suite(run, "attack")


@pytest.mark.integration
@pytest.mark.parametrize("suite", ["online", "offline"])
def test_references_alone_and_models_alone_are_the_rows_of_both_together(folder, tmp_path_factory, suite):
    both = icrl_dist.evaluate(folder, suite=suite, episodes=2, seeds=2, p=[0.2]).rows
    models = icrl_dist.evaluate(folder, suite=suite, episodes=2, seeds=2, p=[0.2], references=False).rows
    settings = with_evaluation(heldout.models(folder)[next(iter(heldout.models(folder)))].run, episodes=2, seeds=2, p=(0.2,))
    results = tmp_path_factory.mktemp("exact")
    alone = heldout.references(settings, suite, results, "exact", lambda event: None)
    assert len(list(results.iterdir())) == 1 and set(alone.run) == {"exact"} and set(alone.policy_version) == {-1}
    assert set(models.agent) == {"t0"} and "t0" not in set(alone.agent)
    key = ["agent", "data", "task_index", "evaluation_seed", "episode"]
    values = ["return", "optimum", "certified", "adversary"]
    together = [*models.to_dict("records"), *alone.to_dict("records")]
    by_key = {tuple(row[name] for name in key): row for row in together}
    assert len(by_key) == len(together) == len(both)
    for row in both.to_dict("records"):
        other = by_key[tuple(row[name] for name in key)]
        np.testing.assert_equal([row[name] for name in values], [other[name] for name in values])


def test_the_posterior_suite_needs_its_reference(folder):
    with pytest.raises(ConfigError, match="compares with the exact agent"):
        icrl_dist.evaluate(folder, suite="posterior", references=False)
