"""Algorithm Distillation: jobs, windows of histories, loss and deployment, against slow loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import icrl_dist
from icrl_dist.config.run import ConfigError, Run, override, validate
from icrl_dist.methods import budget
from icrl_dist.methods import registry as methods
from icrl_dist.methods.ad import AD
from icrl_dist.models.dpt import Transitions
from icrl_dist.problems import registry as problems
from icrl_dist.problems.darkroom.q_learning import QLearningHistories
from icrl_dist.results.heldout import check_suite
from icrl_dist.training.batches import TrainingBatch
from icrl_dist.training.history_windows import HistoryWindows
from icrl_dist.types import NULL, Trajectory
from tests.experts.histories import run as reacher_run
from tests.jobs import FixedWeights, InMemoryDataset, collect, jobs_of

__all__ = ["reacher_run"]

SETTINGS = ["pretrain.contexts=105", "ad.history_episodes=7", "ad.window_episodes=3", "ad.skip=2", "optim.queries=11"]


@pytest.fixture
def ad_run(small_run: Run) -> Run:
    """Seven tasks with 15 episodes each, so histories of 7 and 8; windows of episodes i, i + 2 and i + 4."""
    return override(dataclasses.replace(small_run, method="ad"), SETTINGS, "--set")


def states_of(t: Trajectory) -> np.ndarray:
    return t.observations[:-1]


def actions_of(t: Trajectory) -> np.ndarray:
    return t.actions


def key_of(states: np.ndarray, actions: np.ndarray) -> bytes:
    """Finds a window by its states and actions."""
    return states.tobytes() + actions.astype(np.int64).tobytes()


def drawn(run: Run, made: list[Trajectory], seed: int = 0) -> TrainingBatch:
    method = methods.of(run)
    batch: TrainingBatch = method.data(run, method.phases(run)[0], InMemoryDataset(made))(np.random.default_rng(seed))
    return batch


def test_its_histories_have_the_episodes_of_d_pre(ad_run: Run) -> None:
    """So its environment steps are those of DPT; a variation has as many histories as fit into its episodes."""
    for contexts, histories, trials in ((7 * 15, 2, 15), (7 * 13, 1, 13), (7 * 5, 1, 5), (7 * 21 + 6, 3, 21)):
        run = override(ad_run, [f"pretrain.contexts={contexts}"], "--set")
        payloads = [job.payload for job in jobs_of(run)]
        assert all(isinstance(payload, QLearningHistories) and payload.count == histories for payload in payloads)
        assert {job.trials for job in jobs_of(run)} == {trials}
        costs = [budget.of(dataclasses.replace(run, method=name)) for name in ("ad", "dpt")]
        assert costs[0].environment_steps == costs[1].environment_steps == 7 * trials * 8
        assert costs[0] == costs[1]._replace(label_source="learner's actions")


def test_the_agent_learns_without_disturbance_or_in_the_variations_of_icag(ad_run: Run) -> None:
    assert {v.adversary for job in jobs_of(ad_run) for v in job.variations} == {NULL}
    disturbed = override(ad_run, ["ad.variations=icag", "pretrain.contexts=315"], "--set")
    icag = [v.adversary for job in jobs_of(disturbed, "icag") for v in job.variations]
    jobs = jobs_of(disturbed)
    assert [v.adversary for job in jobs for v in job.variations] == icag and len(set(icag)) > 7
    assert sum(len(job.variations) * job.trials for job in jobs) <= 315


def test_a_batch_holds_windows_of_histories_as_a_slow_loop_cuts_them(ad_run: Run) -> None:
    """Context, query states, prefixes and labels: query t is the state at step t, and its label the action there."""
    made = collect(ad_run, methods.of(ad_run).phases(ad_run)[0])
    dataset, horizon = InMemoryDataset(made), problems.of(ad_run).horizon
    possible = {}
    for key in dataset.variations("pretrain", 0):
        trials = dataset.trials(key)
        assert [t.identity.trial for t in trials] == list(range(15))
        for begin, end in ((0, 7), (7, 15)):
            for first in range(begin, end - 4):
                window = [trials[first], trials[first + 2], trials[first + 4]]
                possible[key_of(*(np.concatenate([c(t) for t in window]) for c in (states_of, actions_of)))] = window
    seen = set[tuple[object, ...]]()
    for seed in range(20):
        batch = drawn(ad_run, made, seed)
        assert batch.prefix.shape == (8, 11) and batch.windows is None
        for b in range(8):
            window = possible[key_of(batch.observations[b], batch.actions[b])]
            seen.add(tuple(window[0].identity))
            steps = [(t, h) for t in window for h in range(horizon)]
            for t, (trial, h) in enumerate(steps):
                np.testing.assert_array_equal(batch.observations[b, t], trial.observations[h])
                np.testing.assert_array_equal(batch.next_observations[b, t], trial.observations[h + 1])
                assert (batch.actions[b, t], batch.rewards[b, t]) == (trial.actions[h], trial.rewards[h])
            assert len(set(batch.prefix[b].tolist())) == 11
            for n, t in enumerate(batch.prefix[b].tolist()):
                trial, h = steps[t]
                np.testing.assert_array_equal(batch.queries[b, n], trial.observations[h])
                assert batch.labels[b, n].tolist() == [float(a == trial.actions[h]) for a in range(5)]
    assert {identity[4] for identity in seen} == {0, 1, 2, 7, 8, 9, 10}, "no window crosses from one history into the next"


def test_a_short_window_has_all_its_steps_as_queries_and_optim_transitions_bounds_a_batch(ad_run: Run) -> None:
    run = override(ad_run, ["optim.queries=100", "optim.transitions=70"], "--set")
    made = collect(run, methods.of(run).phases(run)[0])
    batch = drawn(run, made)
    assert batch.prefix.shape == (70 // 24, 24)
    assert all(sorted(row) == list(range(24)) for row in batch.prefix.tolist())


def test_windows_begin_anywhere_in_a_history() -> None:
    windows = HistoryWindows(count=2, episodes=3, skip=2)
    rng = np.random.default_rng(0)
    found = {tuple(windows.draw(rng, 13).tolist()) for _ in range(200)}
    assert found == {(0, 2, 4), (1, 3, 5), (6, 8, 10), (7, 9, 11), (8, 10, 12)}


def test_the_loss_is_the_cross_entropy_of_each_action_given_what_came_before(ad_run: Run) -> None:
    made, model = collect(ad_run, methods.of(ad_run).phases(ad_run)[0]), FixedWeights(ad_run).model
    batch, method = drawn(ad_run, made), AD()
    total = 0.0
    with torch.no_grad():
        for b in range(len(batch.prefix)):
            for t in batch.prefix[b].tolist():
                columns = (batch.observations, batch.actions, batch.next_observations, batch.rewards)
                before = Transitions(*(torch.from_numpy(column[b : b + 1, :t]) for column in columns))
                state = torch.from_numpy(batch.observations[b, t])[None, None]
                logits = model(before, state, torch.tensor([[t]]))[0, 0]
                total -= float(logits.log_softmax(-1)[int(batch.actions[b, t])])
        assert float(method.loss(model, batch)) == pytest.approx(total / batch.prefix.size, rel=1e-5)


def test_the_compiled_kernel_fits_it_and_its_context_grows(ad_run: Run) -> None:
    method = AD()
    assert method.fits_by_kernel and method.deployment(ad_run) == "growing"
    assert [(p.stage, p.steps) for p in method.phases(ad_run)] == [("pretrain", ad_run.pretrain.steps)]


def test_its_decisions_are_not_compared_with_the_exact_posterior(ad_run: Run) -> None:
    """It imitates a learner, so a perfect model is far from the posterior."""
    with pytest.raises(ConfigError, match="--suite posterior: darkroom with ad has no exact posterior; use --suite online"):
        check_suite(ad_run, "posterior")
    check_suite(dataclasses.replace(ad_run, method="dpt"), "posterior")


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (["ad.skip=4"], "ad.window_episodes = 3: a window takes every 4th of 9 episodes, and a history has 7; use fewer"),
        (["ad.window_episodes=8", "ad.skip=1"], "ad.window_episodes = 8: a window takes 8 episodes, and a history has 7"),
        (["model.window=2", "pretrain.windows=1", "optim.windows=1"], "model.window = 2: use 1"),
        (["dagger.rounds=1"], "dagger.rounds = 1: ad has no such rounds: use 0"),
        (["ad.step=0"], "ad.step = 0.0: a learning rate of Q-learning lies in (0, 1]"),
        (["ad.discount=1"], "ad.discount = 1.0: a discount of Q-learning lies in [0, 1)"),
    ],
)
def test_impossible_settings_are_refused_in_one_line(ad_run: Run, settings: list[str], expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(override(ad_run, settings, "--set"), "run")
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_a_problem_without_histories_is_refused(toy_run: Callable[..., Run]) -> None:
    with pytest.raises(ConfigError, match=r"method = 'ad': toy-corridor records no histories of a learning agent"):
        toy_run(method="ad")


@pytest.mark.integration
def test_sac_histories_are_windows_too(reacher_run: Run) -> None:
    """In a continuous problem the labels are the action vectors of the experts' trainings, in the order of the training."""
    settings = ["ad.window_episodes=2", "ad.skip=2", "pretrain.contexts=16", "optim.queries=9"]
    run = override(dataclasses.replace(reacher_run, method="ad"), settings, "--set")
    validate(run, "run")
    made = collect(run, methods.of(run).phases(run)[0])
    dataset = InMemoryDataset(made)
    assert {len(dataset.trials(key)) for key in dataset.variations("pretrain", 0)} == {4}
    batch = drawn(run, made)
    windows = {
        np.concatenate([t.observations[:-1] for t in trials[first::2]]).tobytes(): trials[first::2]
        for trials in map(dataset.trials, dataset.variations("pretrain", 0))
        for first in (0, 1)
    }
    for b in range(len(batch.prefix)):
        actions = np.concatenate([t.actions for t in windows[batch.observations[b].tobytes()]])
        np.testing.assert_array_equal(batch.labels[b], actions[batch.prefix[b]])


@pytest.mark.integration
def test_it_is_trained_evaluated_and_loaded_like_the_other_methods(ad_run: Run, tmp_path: Path) -> None:
    """Two inline runs have the same digests; rows name the rule; the agent's context grows with every transition."""
    first, second = (icrl_dist.train(ad_run, out=tmp_path / name, engine="inline").result for name in "ab")
    assert first["trajectories"] == 7 * 15
    for digest in ("dataset_digest", "weights_digest"):
        assert first[digest] == second[digest]
    rows = icrl_dist.read_results(tmp_path / "a")
    assert set(rows[rows.agent == "t0"].deployment) == {"growing", "paper"}, "tables show Algorithm 1 beside it"
    agent = icrl_dist.load_agent(tmp_path / "a", seed=0)
    assert agent.deploy == "growing"
    state = np.zeros((1, 2), np.float32)
    for count in range(3):
        assert len(agent.context()[1]) == count
        agent.observe(state, agent.act(state), [0.0], state, [False])
