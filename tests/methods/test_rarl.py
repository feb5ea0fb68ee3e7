"""RARL, QARL and IC2RL in DeepMind Control: policies from games of two players, kept in the cache, in tables and as labels."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import icrl_dist
from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.run import ConfigError, Run, load_run, override
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.experts import cache
from icrl_dist.experts.adversarial import policies
from icrl_dist.experts.adversarial import train as training
from icrl_dist.experts.adversarial.payloads import Game
from icrl_dist.experts.cache import expert_seed
from icrl_dist.experts.sac import draws
from icrl_dist.launch.whole_run import train
from icrl_dist.methods import budget
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.results import evaluate
from icrl_dist.stream import wire
from icrl_dist.types import NULL, Variation
from tests.calls import noting
from tests.experts.histories import digests
from tests.jobs import decoded, do, in_problem, jobs_of
from tests.optional import known

pytestmark = pytest.mark.integration

HORIZON = 20


@pytest.fixture
def run(small_run: Run, tmp_path: Path) -> Run:
    """Four tasks of reacher in two jobs; games of 12 short episodes."""
    sac = SACConfig(hidden=(8, 8), batch=16, random_steps=40, warmup=40, update_every=2, steps=HORIZON * 8)
    return in_problem(
        small_run,
        "dmc-reacher-easy",
        method="rarl",
        control=ControlConfig(train_tasks=4, test_tasks=2, horizon=HORIZON, strength=0.5),
        robust=RobustConfig(adversary_episodes=1, protagonist_episodes=2, teacher_episodes=3),
        adversary=AdversaryConfig(count=1),
        sac=dataclasses.replace(sac, cache=str(tmp_path / "experts")),
        pretrain=dataclasses.replace(small_run.pretrain, contexts=4 * 3, queries=6, steps=2),
        evaluate=dataclasses.replace(small_run.evaluate, p=(0.0,), episodes=1, seeds=1),
    )


@pytest.fixture
def games(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, Any]]:
    """How many tasks were trained each time, and QARL's bounds."""
    trained: list[tuple[int, Any]] = []
    monkeypatch.setattr(training, "train", noting(trained, lambda env, *rest: (env.batch, rest[3]), training.train))
    return trained


def robust_of(run: Run, curriculum: bool) -> list[policies.Robust]:
    problem = registry.of(run)
    game = Game(0.5, run.section("robust"), curriculum)
    return [known(policies.load(task, HORIZON, run.sac, run.seed, game)) for task in problem.split.train]


def test_each_task_gets_one_policy_and_its_undisturbed_episodes_are_delivered(run: Run, games: list[Any]) -> None:
    jobs = jobs_of(run)
    assert [decoded(run, wire.encode_job(job)) for job in jobs] == list(jobs) and len(jobs) == 2
    sent = [t for job in jobs for t in do(run, job)]
    assert [t.identity for t in sent] == [identity for job in jobs for identity in job.identities()]
    assert games == [(2, None), (2, None)]
    found = robust_of(run, False)
    assert len({one.actor.tobytes() for one in found}) == 4 and all(len(one.returns) == 12 for one in found)
    for t in sent:
        one = found[t.identity.task]
        act = policies.act_of([one], run.sac, Game(0.5, run.section("robust"), False))
        np.testing.assert_allclose(t.actions, act(t.observations[None, :-1])[0], atol=1e-5)
        assert t.variation.adversary == NULL and not t.adversary.any() and t.origin == "none"
        env, trial = (
            registry.of(run).batch([t.variation]),
            draws.key(expert_seed(t.variation, 0), draws.WINDOWS, t.identity.trial),
        )
        env.reset([np.random.default_rng(trial)])
        again = [env.step(action[None]).observation[0] for action in t.actions]
        np.testing.assert_array_equal(t.observations[1:], again)
    assert digests(do(run, jobs[0])) == digests(sent[: len(sent) // 2]) and len(games) == 2, "from the cache"


def test_the_adversary_has_the_strength_of_training_adversaries(run: Run) -> None:
    player = known(registry.of(run).second_player)
    task = registry.of(run).split.train[0]
    assert player.strength == 0.5
    strong, weak = (player.batch([task], strength) for strength in (0.5, 0.0))
    for env in (strong, weak):
        env.reset([np.random.default_rng(0)])
    push = np.full((1, strong.disturbance), -1.0, np.float32)
    still = np.zeros((1, strong.spec.actions), np.float32)
    steps = [env.step(still, push) for env in (strong, weak)]
    np.testing.assert_array_equal(steps[0].adversary, 0.5 * push)
    assert (steps[0].observation != steps[1].observation).any()
    with pytest.raises(ValueError, match=r"disturbances .* expected numbers in \[-1, 1\]"):
        strong.step(still, 2 * push)


def test_qarls_bounds_are_shares_of_the_experts_discounted_returns(run: Run, games: list[Any]) -> None:
    qarl = dataclasses.replace(run, method="qarl")
    for job in jobs_of(qarl):
        do(qarl, job)
    tasks = registry.of(run).split.train
    slow = []
    for task in tasks:
        history = known(cache.load_any(Variation(task), HORIZON, run.sac, run.seed))
        each = [sum(0.9**h * float(reward) for h, reward in enumerate(rewards)) for rewards in history.window_rewards]
        slow.append(0.7 * sum(each) / len(each))
    np.testing.assert_allclose(np.concatenate([bounds for _, bounds in games]), slow, rtol=1e-5)
    found = robust_of(run, True)
    np.testing.assert_allclose([one.bound for one in found], slow, rtol=1e-5)
    assert all(1.0 <= one.concentration <= 50.0 for one in found)


def test_only_what_decides_a_policy_is_in_its_key(run: Run) -> None:
    robust, task = run.section("robust"), registry.of(run).split.train[0]

    def key(sac: SACConfig = run.sac, seed: int = 0, strength: float = 0.5, curriculum: bool = False, **changes: Any) -> str:
        game = Game(strength, dataclasses.replace(robust, **changes), curriculum)
        return cache.key(Variation(task), HORIZON, sac, seed, "lockstep", game=game.key())

    def qarl(name: str, value: float) -> str:
        changes: dict[str, Any] = {name: value}
        return key(curriculum=True, **changes)

    assert key() == key(bound=0.5) == key(rate=9.0), "RARL has no curriculum"
    others = [
        key(strength=0.6),
        key(seed=1),
        key(dataclasses.replace(run.sac, gamma=0.5)),
        key(adversary_episodes=3),
        key(protagonist_episodes=3),
        key(curriculum=True),
        *(qarl(name, 2.0) for name in ("first_concentration", "last_concentration", "rate", "divergence")),
        *(qarl(name, 0.25) for name in ("bound", "most_temperature")),
        key(curriculum=True, teacher_episodes=4),
        cache.key(Variation(task), HORIZON, run.sac, 0, "lockstep"),
    ]
    assert len({key(), *others}) == len(others) + 1


def test_tables_have_the_policies_of_the_evaluated_tasks_that_are_in_the_cache(run: Run) -> None:
    problem = registry.of(run)
    assert list(problem.references(run)) == ["random"]
    first, second = jobs_of(run)
    do(run, first)
    assert list(problem.references(run)) == ["random"], "only some of the tasks"
    do(run, second)
    references = problem.references(run)
    assert list(references) == ["random", "rarl"] and not references["rarl"].ceiling
    other = override(run, ["robust.adversary_episodes=3"], "x")
    assert list(problem.references(other)) == ["random"]
    rows = [Variation(task) for task in problem.evaluated]
    env = problem.batch(rows)
    policy, observation = references["rarl"].make(rows, env), env.reset([np.random.default_rng(i) for i in range(4)])
    actions = policy.act(observation, np.zeros((4, 2)))
    for row, one in enumerate(robust_of(run, False)):
        alone = policies.act_of([one], run.sac, Game(0.5, run.section("robust"), False))(observation[row][None, None])
        np.testing.assert_allclose(actions[row], alone[0, 0], atol=1e-5)
    agents = {evaluate.Agent(key): reference for key, reference in references.items()}
    assert [result.agent.key for result in evaluate.online(run, agents)] == ["random", "rarl"]


def test_ic2rl_has_dpts_histories_with_the_actions_of_rarls_policies_as_labels(run: Run, games: list[Any]) -> None:
    windowed = dataclasses.replace(
        run,
        method="ic2rl",
        model=dataclasses.replace(run.model, window=3),
        pretrain=dataclasses.replace(run.pretrain, windows=2, decoy_fraction=0.0),
        optim=dataclasses.replace(run.optim, windows=1),
    )
    jobs, theirs = jobs_of(windowed), jobs_of(windowed, "dpt")
    assert [decoded(windowed, wire.encode_job(job)) for job in jobs] == list(jobs)
    sent, dpts = ([t for job in of for t in do(windowed, job)] for of in (jobs, theirs))
    assert [size for size, _ in games] == [2, 2]
    found, game = robust_of(run, False), Game(0.5, run.section("robust"), False)
    for t, other in zip(sent, dpts, strict=True):
        assert (t.identity, t.variation, t.origin) == (other.identity, other.variation, "expert")
        for name in ("observations", "actions", "rewards", "adversary"):
            np.testing.assert_array_equal(getattr(t, name), getattr(other, name))
        np.testing.assert_array_equal(t.queries[:6], other.queries[:6])
        one = found[t.identity.task]
        np.testing.assert_allclose(t.labels, policies.act_of([one], run.sac, game)(t.queries[None])[0], atol=1e-5)
        assert (t.labels[:6] != other.labels[:6]).any()
        acted = one.window_observations[:, :-1].reshape(-1, 6)
        assert all((acted == query).all(axis=1).any() for query in t.queries[6:]) and len(t.queries) == 12
    assert budget.of(windowed).label_source == "robust expert"


def test_budgets_count_the_steps_of_both_players_and_of_the_bounds(run: Run) -> None:
    each = {method: budget.of(dataclasses.replace(run, method=method)) for method in ("rarl", "qarl", "dpt", "ic2rl")}
    game, expert = 4 * (12 + 8) * HORIZON, 4 * (8 + 8) * HORIZON
    assert (each["rarl"].environment_steps, each["qarl"].environment_steps) == (game, game + expert)
    assert each["ic2rl"].environment_steps - each["dpt"].environment_steps == game
    assert each["dpt"].environment_steps == expert and each["rarl"].labelled_episodes == 0


@pytest.mark.parametrize("problem", ["darkroom-7x7", "metaworld-laptop"])
@pytest.mark.parametrize("method", ["rarl", "qarl"])
def test_a_problem_without_a_second_player_is_refused_in_one_line(problem: str, method: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_run(problem, f"method={method}")
    name = load_run(problem).problem
    remedy = f"{name} has no second player, which {method} trains as adversary: use dpt or icag"
    assert str(caught.value) == f"{problem}: method = {method!r}: {remedy}"


def test_a_run_that_would_keep_no_policy_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^dmc-reacher-easy-laptop: sac.cache = '': rarl keeps its policies only there"):
        load_run("dmc-reacher-easy-laptop", "method=rarl", "sac.cache=")


def test_a_strength_that_is_not_known_is_refused_with_the_remedy() -> None:
    for method in ("rarl", "ic2rl"):
        with pytest.raises(ConfigError, match=r"drop:0.13.*bench disturbance") as caught:
            load_run("dmc-reacher-easy-laptop", f"method={method}", "control.strength=drop:0.13")
        assert "\n" not in str(caught.value)


def test_a_run_trains_the_policies_and_a_later_one_uses_them(run: Run, games: list[Any], tmp_path: Path) -> None:
    trained = train(run, tmp_path / "rarl", engine="inline")
    assert set(trained.evaluation.rows["agent"]) == {"rarl"} and len(trained.evaluation.rows) == 4 * 8
    assert "RARL policies" in str(trained.evaluation.tables[0].title)
    later = train(dataclasses.replace(run, method="ic2rl"), tmp_path / "ic2rl", engine="inline")
    assert {"t0", "random", "expert", "rarl"} == set(later.evaluation.rows["agent"]) and len(games) == 2
    worst = icrl_dist.evaluate(later.folder, suite="worst", p=1.0, adversaries=1, steps=60, episodes=1)
    assert [row["key"] for row in worst.summary["worst"]] == ["t0", "expert", "rarl"]
    assert [path.name.split("-")[0] for path in (later.folder / "report").glob("worst-*-1adversaries-60steps.json")] == [
        "worst"
    ]
    with pytest.raises(ConfigError, match=r"^--steps 0: at least 1 is needed$"):
        icrl_dist.evaluate(later.folder, suite="worst", steps=0)
