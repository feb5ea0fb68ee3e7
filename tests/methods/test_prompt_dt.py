"""Prompt-DT and ARDT as methods: contexts, target, and a run that is trained, interrupted, resumed and deployed."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import icrl_dist
from icrl_dist.config.run import ConfigError, Run, override, validate
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.launch import train
from icrl_dist.methods import budget
from icrl_dist.methods import registry as methods
from icrl_dist.methods.ardt import ARDTConfig
from icrl_dist.methods.prompt_dt import PromptDTConfig
from icrl_dist.models.segments import returns_to_go
from icrl_dist.problems import registry as problems
from icrl_dist.problems.darkroom.game import PlayGame
from icrl_dist.types import NULL
from learner import fitting
from tests.jobs import InMemoryDataset, collect, in_problem

NAMES = ("prompt_dt", "ardt")


def asked(run: Run, method: str, **fields: Any) -> Run:
    small = {"prompt_dt": PromptDTConfig(window=4, prompt=3), "ardt": ARDTConfig(steps=20, batch=4, width=8)}
    return in_problem(dataclasses.replace(run, method=method), "darkroom", darkroom=run.section("darkroom"), **small, **fields)


def test_prompt_dt_takes_the_contexts_of_dpt_and_ardt_those_of_icag(small_run: Run) -> None:
    for method, same in (("prompt_dt", "dpt"), ("ardt", "icag")):
        runs = [asked(small_run, name) for name in (method, same)]
        one, two = (
            [job for phase in methods.of(run).phases(run)[:1] for job in methods.of(run).ask(run, phase)] for run in runs
        )
        assert one == two and methods.of(runs[0]).phases(runs[0]) == methods.of(runs[1]).phases(runs[1])[:1]


def test_the_target_is_the_largest_return_of_the_training_trajectories(small_run: Run) -> None:
    run = asked(small_run, "prompt_dt")
    method = methods.of(run)
    (phase,) = method.phases(run)
    data = InMemoryDataset(collect(run, phase))
    batch = method.data(run, phase, data)(np.random.default_rng(0))
    returns = [t.episode_return for t in data.trajectories]
    assert batch.target == batch.scale == max(returns) > np.mean(returns)
    assert batch.window.to_go.shape == (2 * run.optim.batch, 4) and batch.prompt.to_go.shape == (2 * run.optim.batch, 3)
    model = method.build(problems.of(run).spec, run)
    method.loss(model, batch)
    assert model.state_dict()["target"] == max(returns)


def test_ardt_relabels_windows_with_the_adversarys_actions_and_leaves_prompts(small_run: Run) -> None:
    run = asked(small_run, "ardt")
    method = methods.of(run)
    (phase,) = method.phases(run)
    made = collect(run, phase)
    disturbed = [t for t in made if t.variation.adversary != NULL]
    assert any((t.adversary >= 0).any() for t in disturbed)

    def histories(trajectories: list[Any], seed: int = 0) -> Any:
        one = dataclasses.replace(run, seed=seed)
        return methods.of(run).data(one, phase, InMemoryDataset(trajectories)).keywords["histories"]  # type: ignore[attr-defined]

    ours = histories(made)
    for one in ours:
        np.testing.assert_array_equal(one.observed, returns_to_go(one.rewards))
        assert abs(one.to_go - one.observed).max() > 0
    again, others = histories(made), histories(made, seed=1)
    np.testing.assert_array_equal(ours[3].to_go, again[3].to_go)
    assert (ours[3].to_go != others[3].to_go).any()
    unseen = [dataclasses.replace(t, adversary=np.full_like(t.adversary, -1)) for t in made]
    assert (histories(unseen)[3].to_go != ours[3].to_go).any(), "logged actions of the adversary are used"
    batch = method.data(run, phase, InMemoryDataset(made))(np.random.default_rng(0))
    assert batch.target == max(float(one.to_go[:, 0].max()) for one in ours)


def test_a_window_or_a_prompt_beyond_the_horizon_is_refused(small_run: Run) -> None:
    for key in ("window", "prompt"):
        run = asked(small_run, "ardt")
        run = dataclasses.replace(run, prompt_dt=PromptDTConfig(**{"window": 8, "prompt": 8, key: 9}))  # type: ignore[call-arg]
        with pytest.raises(ConfigError, match=rf"prompt_dt\.{key} = 9: use 1 to 8: at most the horizon, 8 steps"):
            validate(run, "test")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (["dagger.rounds=2"], "dagger.rounds = 2: {} has no such rounds: use 0"),
        (
            ["model.window=2", "pretrain.windows=1", "optim.windows=1"],
            "pretrain.windows = 1: {} reads no action windows: use 0, and optim.windows = 0 and model.window = 1",
        ),
    ],
)
def test_settings_that_they_ignore_are_refused_in_one_line(
    small_run: Run, name: str, settings: list[str], expected: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(override(asked(small_run, name), settings, "x"), "test")
    assert expected.format(name) in str(caught.value) and "\n" not in str(caught.value)


def test_their_budgets_are_those_of_dpt_with_logged_actions_as_labels(small_run: Run) -> None:
    of = {name: asked(small_run, name, adversary=AdversaryConfig(count=2)) for name in ("dpt", *NAMES)}
    assert not budget.differences({name: [run] for name, run in of.items()})
    assert [budget.of(of[name]).label_source for name in NAMES] == ["logged actions"] * 2


def test_the_steps_of_the_return_nets_are_beside_the_optimizer_steps(small_run: Run) -> None:
    runs = {name: asked(small_run, name, adversary=AdversaryConfig(count=2)) for name in ("dpt", *NAMES)}
    assert [budget.of(runs[name]).extra_steps for name in runs] == [0, 0, 20]
    assert budget.of(runs["ardt"]).optimizer_steps == budget.of(runs["prompt_dt"]).optimizer_steps


def test_ardt_without_adversaries_is_refused(small_run: Run) -> None:
    run = asked(small_run, "ardt", adversary=AdversaryConfig(count=0))
    with pytest.raises(ConfigError, match=r"adversary\.count = 0: .* or the method prompt_dt"):
        validate(run, "test")
    validate(dataclasses.replace(run, method="prompt_dt"), "test")


def test_they_are_not_fitted_by_the_kernel_and_have_no_rule_but_algorithm_1(small_run: Run) -> None:
    for name in NAMES:
        run = asked(small_run, name)
        method, spec = methods.of(run), problems.of(run).spec
        assert not method.fits_by_kernel and method.deployment(run) == "paper"
        model = method.build(spec, run)
        with pytest.raises(ConfigError, match="deploy = 'committed'"):
            method.policy(model, 1, run.context, "committed")


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_a_run_that_is_resumed_has_the_same_bytes_and_its_agent_the_same_target(
    small_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    run = asked(small_run, name, evaluate=dataclasses.replace(small_run.evaluate, episodes=2, seeds=1))
    monkeypatch.setattr(fitting, "SAVE_STEPS", 4)

    class Killed(Exception):  # noqa: N818
        pass

    def kill(event: dict[str, Any]) -> None:
        if event.get("stage") == "fit" and event["step"] == run.pretrain.steps:
            raise Killed

    whole = icrl_dist.train(run, out=tmp_path / "whole", engine="inline").result
    run = icrl_dist.load_run(tmp_path / "whole")
    train.prepare(run, tmp_path / "cut", resume=False, overwrite=False)
    with pytest.raises(Killed):
        train.train_inline(run, tmp_path / "cut", kill)
    train.prepare(run, tmp_path / "cut", resume=True, overwrite=False)
    cut = train.train_inline(run, tmp_path / "cut", lambda event: None)
    for digest in ("weights_digest", "dataset_digest"):
        assert cut[digest] == whole[digest]
    agents = {row["agent"] for row in whole["rows"]}
    assert any(name in agent or agent == "T^0" for agent in agents), agents
    offline = icrl_dist.evaluate(tmp_path / "whole", suite="offline")
    assert {"random", "expert"} <= set(offline.rows["data"])
    agent = icrl_dist.load_agent(tmp_path / "whole", seed=0)
    assert agent.model.state_dict()["target"] != 0
    task = problems.of(run).split.test[0]
    env = icrl_dist.make(icrl_dist.Variation(task))
    for episode in range(2):
        obs, done = env.reset(seed=episode)[0], False
        while not done:
            action = agent.act([obs])
            following, reward, _, done, _ = env.step(action[0])
            agent.observe([obs], action, [reward], [following], [done])
            obs = following
    assert agent.distribution([obs]).sum() == pytest.approx(1.0, abs=1e-5)
    assert len(agent.context()[1]) == 2 * run.section("darkroom").horizon
    game = PlayGame(agent, run)
    for _ in range(2 * game.horizon):
        game.step()
    assert game.belief().transitions == 2 * game.horizon
