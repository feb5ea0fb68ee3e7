"""Evaluation and the agent against exact answers."""

import dataclasses
import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from icrl_dist import InContextAgent, make, read_results
from icrl_dist.agent.loading import load_agent
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig, EvaluateConfig
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.problem import EXPERT
from icrl_dist.problems.darkroom import divergence, room
from icrl_dist.problems.darkroom.exact_agents import KEYS, ExactAgent
from icrl_dist.problems.darkroom.problem import ORACLE, DarkRoomProblem
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns, soft_labels
from icrl_dist.results import evaluate, plots, statistics, summaries
from icrl_dist.results.evaluate import Agent
from icrl_dist.results.returns import returns
from icrl_dist.results.statistics import mean_and_error
from icrl_dist.results.tables import returns_table
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, version_file
from icrl_dist.storage.files import StoreError
from icrl_dist.types import Variation
from learner import checkpoints
from tests.optional import known
from tests.results.row_blocks import block, frame


@pytest.fixture
def untrained(small_run):
    """An untrained model of ``small_run``."""
    torch.manual_seed(0)
    spec = registry.of(small_run).spec
    return TrainedModel(small_run, methods.of(small_run), spec, PretrainedTransformer(spec, small_run.model).eval())


def references(run):
    return registry.of(run).references(run)


def test_the_oracle_reaches_the_exact_optimum_and_other_agents_stay_below_it(small_run, untrained):
    run = dataclasses.replace(small_run, evaluate=dataclasses.replace(small_run.evaluate, seeds=60, p=(0.0, 0.4)))
    found = references(run)
    model = evaluate.in_context(untrained, untrained.run.context)
    agents = {Agent("t0"): model, Agent("random"): found["random"], Agent(ORACLE): found[ORACLE]}
    for result in evaluate.online(run, agents):
        assert result.ceiling == (result.agent == Agent(ORACLE))
        assert result.returns.shape == (len(registry.of(run).split.test), 60, 3)
        error = result.returns.mean(axis=(0, 2)).std() / np.sqrt(60)
        assert result.optimum is not None
        if result.agent.key == ORACLE:
            assert abs(result.returns.mean() - result.optimum.mean()) < 4 * error + 0.05
        else:
            assert result.returns.mean() < result.optimum.mean() - 4 * error


def test_all_agents_have_the_same_draws(small_run, untrained):
    agents = {
        Agent("one"): evaluate.in_context(untrained, untrained.run.context),
        Agent("two"): evaluate.in_context(untrained, untrained.run.context),
    }
    one, two, *_ = evaluate.online(small_run, agents)
    np.testing.assert_array_equal(one.returns, two.returns)


def test_the_draws_at_one_p_are_the_same_alone_and_in_any_list(small_run):
    def returns(*levels):
        evaluated = dataclasses.replace(small_run.evaluate, p=levels, seeds=5)
        agents = {Agent("random"): references(small_run)["random"]}
        found = evaluate.online(dataclasses.replace(small_run, evaluate=evaluated), agents)
        return {result.p: result.returns for result in found}

    alone, listed, turned = returns(0.3), returns(0.0, 0.2, 0.3), returns(0.3, 0.0)
    np.testing.assert_array_equal(alone[0.3], listed[0.3])
    np.testing.assert_array_equal(alone[0.3], turned[0.3])
    np.testing.assert_array_equal(listed[0.0], turned[0.0])
    assert not np.array_equal(listed[0.2], listed[0.3])


def test_held_out_variations_start_in_the_origin(small_run):
    chosen = evaluate.variations(small_run, 0.2)
    assert [v.task.vector("goal") for v in chosen] == [t.vector("goal") for t in registry.of(small_run).split.test]
    assert all(v.task.vector("start") == (0, 0) and v.adversary.number("p") == 0.2 for v in chosen)


def test_each_evaluation_of_a_task_is_under_its_own_adversary_and_the_first_repeats_old_numbers(small_run):
    def of(seeds):
        run = dataclasses.replace(small_run, evaluate=dataclasses.replace(small_run.evaluate, seeds=seeds, p=(0.4,)))
        agents = {Agent("random"): references(run)["random"], Agent(ORACLE): references(run)[ORACLE]}
        return evaluate.online(run, agents)

    alone, several = of(1), of(3)
    for one, many in zip(alone, several, strict=True):
        np.testing.assert_array_equal(one.returns[:, 0], many.returns[:, 0])
        assert [of_task[0] for of_task in many.variations] == list(evaluate.variations(small_run, 0.4))
        assert all(
            len({v.adversary for v in of_task}) == 3 and len({v.task for v in of_task}) == 1 for of_task in many.variations
        )
        assert known(many.optimum).shape == (2, 3) and len(np.unique(known(many.optimum)[0])) == 3


def test_numbers_of_result_json_are_means_over_tasks_and_seeds():
    returns = np.arange(12.0).reshape(2, 2, 3)
    (row,) = summaries.result_rows(frame(block(returns, p=0.2, optimum=[10.0, 12.0])))
    assert row["episodes"] == [4.5, 5.5, 6.5] and row["optimum"] == 11.0
    assert row["last5_over_optimum"] == round(5.5 / 11, 4)
    assert (row["agent"], row["key"], row["deployment"], row["p"]) == ("T^0 (dpt)", "t0", "paper", 0.2)
    error = np.std([3, 6], ddof=1) / np.sqrt(2)
    assert row["standard_error"] == [round(error, 3)] * 3
    mean, errors = mean_and_error(returns)
    np.testing.assert_allclose(errors, np.full(3, error))
    np.testing.assert_allclose(mean, [4.5, 5.5, 6.5])


def test_adaptation_is_measured_relative_to_the_oracle():
    def result(*tasks):
        (found,) = returns(frame(block([[task] for task in tasks], optimum=[9.0] * len(tasks))))
        return found

    oracle, model = result((10, 10, 8, 12)), result((1, 8, 9, 10))
    assert summaries.first_over(model, oracle, 2) == round(9 / 20, 4)
    assert summaries.first_over(model, oracle, 10) == round(28 / 40, 4)
    assert [summaries.episode_of(model, oracle, share) for share in (0.05, 0.9, 0.95)] == [1, 3, 4]
    assert summaries.episode_of(model, oracle, 1.01) is None
    assert summaries.episode_of(result((0, 12), (6, 6)), oracle, 0.9) == 2, "not of all tasks and seeds together"
    both = frame(block([[(1, 8, 9, 10)]], "t2"), block([[(10, 10, 8, 12)]], "oracle", ceiling=True, optimum=[9.0]))
    assert summaries.adaptation(both) == {"first10_over_oracle": {"0": 0.7}, "episode_of_90": {"0": 3}}


def test_offline_rows_have_random_and_expert_data(small_run, untrained):
    rows = evaluate.offline(small_run, {Agent("t0", "paper", 0): untrained})
    agents = ["T^0 (icaa)", *DarkRoomProblem.agent_names.values()]
    count = 1 + len(agents)
    found = frame(*(row.block(small_run, "run", "evaluated") for row in rows), suite="offline")
    named = [row["agent"] for row in summaries.result_rows(found)]
    for names, source in ((named[:count], "random data"), (named[count : 2 * count], "expert data")):
        assert names == [source, *(f"{agent}, {source}" for agent in agents)]
    expert = next(r for r in rows if r.agent.key == ORACLE and r.p == 0)
    np.testing.assert_allclose(expert.returns.mean(axis=(1, 2)), known(expert.optimum).mean(axis=1))
    informed = next(r for r in rows if (r.agent.key, r.data, r.p) == (KEYS["paper"], "expert", 0))
    np.testing.assert_array_equal(informed.returns, expert.returns)


def test_exact_agents_find_the_goal_and_know_the_adversary_of_their_row(small_run):
    run = dataclasses.replace(small_run, evaluate=EvaluateConfig(episodes=6, seeds=20, p=(0.0, 0.4), prior="unseen"))
    agents = {Agent(key): reference for key, reference in references(run).items() if key != "random"}
    assert [agent.key for agent in agents] == [*DarkRoomProblem.agent_names, ORACLE]
    results = {(r.agent.key, r.p): r.returns for r in evaluate.online(run, agents)}
    for name in KEYS.values():
        np.testing.assert_array_equal(results[name, 0.0][:, :, -1], results[ORACLE, 0.0][:, :, -1])
        error = results[name, 0.4].mean(axis=(0, 2)).std() / np.sqrt(20)
        assert abs(results[name, 0.4][:, :, -2:].mean() - results[ORACLE, 0.4].mean()) < 5 * error
    early = {rule: results[name, 0.0][:, :, :2].mean() for rule, name in KEYS.items()}
    assert early["paper"] < early["every step"] < early["committed"]
    rows = evaluate.variations(run, 0.4)
    goals = [room.task(divmod(cell, 3), 3, 8) for cell in range(9)]
    families = [Hypotheses.of([Variation(goal, row.adversary) for goal in goals]) for row in rows]
    labels = [soft_labels(h, run.section("darkroom").gamma, run.section("darkroom").label_slack) for h in families]
    assert not np.array_equal(labels[0], labels[1])
    own = ExactAgent(families, labels, np.arange(2), "every step")
    made = known(registry.of(run).exact).agent(run, "every step")(rows, registry.batch(rows))
    assert isinstance(made, ExactAgent)
    for cell in range(9):
        observation = np.array([divmod(cell, 3)] * 2, np.float32)
        np.testing.assert_array_equal(made.probabilities(observation), own.probabilities(observation))


def test_the_agent_repeats_its_actions_after_a_reset_of_context_and_draws(untrained):
    run = dataclasses.replace(untrained.run, context=ContextConfig(max=100))
    env = make(evaluate.variations(run, 0.0)[0])
    agent = InContextAgent(TrainedModel(run, untrained.method, untrained.spec, untrained.model), {}, seed=3)

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


def test_the_agent_names_wrong_shapes(untrained):
    agent = InContextAgent(untrained, {})
    agent.reset_context(batch=3)
    with pytest.raises(ValueError, match=r"obs has shape \(2, 2\), expected \(3, 2\)"):
        agent.act(np.zeros((2, 2), np.float32))
    good = (np.zeros((3, 2)), np.zeros(3, int), np.zeros(3), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="end together"):
        agent.observe(*good, np.array([True, False, True]))
    with pytest.raises(ValueError, match=r"reward has shape"):
        agent.observe(*good[:2], np.zeros(2), good[3], np.zeros(3, bool))


def test_a_missing_or_damaged_checkpoint_is_refused_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match="no such run folder or checkpoint"):
        load_agent(tmp_path / "nothing")
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(ConfigError, match="holds no checkpoint yet"):
        load_agent(tmp_path)
    (tmp_path / "checkpoints" / "version-0000.npz").write_bytes(b"garbage")
    with pytest.raises(StoreError, match="not a checkpoint"):
        load_agent(tmp_path)


def test_a_result_has_the_exact_optimum_of_its_variations(small_run):
    (result, *_) = evaluate.online(small_run, {Agent("random"): references(small_run)["random"]})
    for of_task, optimum in zip(result.variations, known(result.optimum), strict=True):
        np.testing.assert_allclose(optimum, optimal_returns(Hypotheses.of(of_task)))


@pytest.fixture
def folder(small_run, tmp_path, monkeypatch):
    """A run folder with the untrained T^0 of an ICAG run; the suite has few contexts and resamples."""
    run = dataclasses.replace(small_run, method="icag")
    torch.manual_seed(0)
    spec = registry.of(run).spec
    model = PretrainedTransformer(spec, run.model)
    monkeypatch.setattr(divergence, "CONTEXTS", 4)
    monkeypatch.setattr(statistics, "RESAMPLES", 100)
    arrays = {f"model/{name}": value for name, value in weights_of(model).items()}
    manifest = checkpoints.manifest(run, spec, 0, 1)
    save_checkpoint(version_file(tmp_path, 0), Checkpoint(arrays, manifest))
    return tmp_path


@pytest.mark.integration
def test_the_suite_ends_with_one_json_object(folder, capsys):
    assert main.main(["evaluate", str(folder), "--suite", "posterior", "--seeds", "2", "--episodes", "6", "--json"]) == 0
    printed = capsys.readouterr()
    answer = json.loads(printed.out.splitlines()[-1])
    for name, prior in itertools.product(("kl_nats", "kl_heldout"), divergence.PRIORS):
        rows = answer[f"{name}{prior}_cells"]
        assert [(row["kind"], row["p"]) for row in rows] == [(kind, p) for p in (0.0, 0.2) for kind in divergence.KINDS]
        assert answer[f"{name}{prior}"] == pytest.approx(np.mean([row["kl"] for row in rows]))
        assert all(answer[f"{name}{prior}{part}"] > 0 for part in ("", "_standard_error", "_goal_met", "_goal_unmet"))
    for name in ("paper_gap", "paper_gap_train"):
        assert list(answer[name]) == ["0", "0.2", "0.4", "0.6"]
        assert all(row["low"] <= row["gap"] <= row["high"] for row in answer[name].values())
        assert all(row["gap"] == pytest.approx(row["model"] / row["exact"] - 1) for row in answer[name].values())
    assert not any(key.endswith("_curves") for key in answer)
    (report,) = (folder / "report").glob("posterior-T*-paper-uniform-p0_0.2_0.4_0.6-6episodes-2seeds.json")
    kept = json.loads(report.read_text())
    assert {key: kept[key] for key in answer if key in kept}.items() <= answer.items()
    kept["paper_gap"]["0"] |= {"low": None, "high": None}
    assert plots.agreement(kept, folder / "without-interval.png", "").exists()
    assert all(len(c["kl"]) == 17 for c in kept["kl_heldout_any_curves"]["by_prefix"])
    assert Path(answer["figure"]).read_bytes().startswith(b"\x89PNG")
    assert all(meaning in printed.err for meaning in divergence.PRIORS.values()) and f"{answer['kl_nats']:.4f}" in printed.err


@pytest.mark.integration
def test_evaluations_add_rows_and_replace_no_report_of_other_settings(folder, capsys):
    reports = dict[Path, bytes]()
    for words in (["--p", "0", "0.2"], ["--p", "0.2"], ["--p", "0.2", "--seeds", "1"], ["--suite", "offline"]):
        assert main.main(["evaluate", str(folder), "--episodes", "2", *words]) == 0
        for name, content in reports.items():
            assert name.read_bytes() == content
        reports = {path: path.read_bytes() for path in (folder / "report").iterdir()}
    assert len(reports) == 3 * 2 and len(list((folder / "results").iterdir())) == 4
    frame = read_results(folder)
    online = frame[frame.suite == "online"]
    assert set(online.p) == {0.0, 0.2} and set(frame.suite) == {"online", "offline"}
    assert not online.duplicated(["agent", "p", "task_index", "evaluation_seed", "episode"]).any()
    assert "not finished" not in capsys.readouterr().out
    file = version_file(folder, 0)
    (folder / "run.toml").write_text(str(load_checkpoint(file).manifest["run"]))
    assert main.main(["evaluate", str(file), "--episodes", "1", "--p", "0"]) == 0
    assert len(list((folder / "results").iterdir())) == 5, "rows of a checkpoint file in a run folder belong to the run"
    shutil.copy(file, folder / "agent.npz")
    assert main.main(["evaluate", str(folder / "agent.npz"), "--episodes", "1", "--p", "0"]) == 0
    frame = read_results(folder, unfinished=True)
    assert (
        set(frame.run) == {folder.resolve().name}
        and len(frame[(frame.suite == "online") & (frame.p == 0)].episode.unique()) == 1
    )
    assert main.main(["evaluate", str(folder), "--episodes", "1", "--p", "0"]) == 0
    assert f"{folder}: this run is not finished; the newest version so far is evaluated" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--p", "1.5"), r"evaluate.p = 1.5: a probability lies in [0, 1]"),
        (("--episodes", "0"), "evaluate.episodes = 0: must be above 0"),
        (("--seeds", "0"), "evaluate.seeds = 0: must be above 0"),
    ],
)
def test_an_impossible_setting_of_the_suite_is_refused_in_one_line(folder, capsys, arguments, expected):
    words = ["evaluate", str(folder), "--suite", "posterior", *arguments]
    assert main.main(words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert expected in line


@pytest.mark.parametrize(("best", "share"), [([4.0, 8.0], "50%"), ([0.0, 0.0], "-")])
def test_the_table_shows_returns_as_a_share_of_the_experts_even_if_that_is_0(best, share):
    blocks = [block([[[2.0, 4.0]]], "t1"), block([[best]], EXPERT, ceiling=True)]
    table = returns_table(frame(*({**one, "problem": "dmc-cheetah-run"} for one in blocks)), "")
    assert table.columns[-1].header == "of SAC expert" and next(iter(table.columns[-1].cells)) == share
