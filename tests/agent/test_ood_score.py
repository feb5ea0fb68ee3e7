"""Out-of-distribution score: readout and calibration against slow loops, and a disturbance that was never trained on."""

import dataclasses

import numpy as np
import pytest
import torch

from icrl_dist.agent import ood_score
from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.agent.loading import calibrated, load_agent, outcomes_of, shipped, trained
from icrl_dist.agent.ood_score import Surprise
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, parse
from icrl_dist.methods import registry as methods
from icrl_dist.models.outcome_readout import RARE, WINDOWS, OutcomeModel
from icrl_dist.problems import registry
from icrl_dist.results import evaluate, summaries
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError
from icrl_dist.types import NULL, Spec
from tests.results.row_blocks import block, frame

B, D = 6, 4
SPECS = (Spec((0.0, -1.0), (9.0, 1.0), 3, 5), Spec((0.0, -1.0), (9.0, 1.0), 2, 5, discrete=False))


def decisions(spec, steps, seed, noise=0.1):
    """Steps of B environments whose outcomes depend on state and action, with noise."""
    rng = np.random.default_rng(seed)
    weights = np.random.default_rng(99).normal(size=(D, spec.actions, spec.observation + 1)) / D
    made = []
    for _ in range(steps):
        state = rng.normal(size=(B, D)).astype(np.float32)
        action = (
            rng.integers(spec.actions, size=B) if spec.discrete else rng.uniform(-1, 1, (B, spec.actions)).astype(np.float32)
        )
        encoded = np.eye(spec.actions)[action] if spec.discrete else action
        comes = np.einsum("bd,ba,dao->bo", state, encoded, weights) + noise * rng.normal(size=(B, spec.observation + 1))
        before = rng.uniform(0, 1, (B, spec.observation)).astype(np.float32)
        after = before + comes[:, :-1].astype(np.float32) * np.array([4.5, 1.0], np.float32)
        made.append((state, before, action, comes[:, -1].astype(np.float32), after))
    return made


def outcome_of(spec, one, row):
    """The target: the change of the observation in units of half the spec's range, and the reward."""
    _, before, _, reward, after = one
    change = [(after[row][i] - before[row][i]) / ((spec.high[i] - spec.low[i]) / 2) for i in range(spec.observation)]
    return np.array([*change, reward[row]], np.float64)


def features_of(spec, one, row):
    state, action = [*one[0][row], 1.0], one[2][row]
    inputs = [*(float(a == action) for a in range(spec.actions)), 1.0] if spec.discrete else [*action, 1.0]
    return np.array([s * t for s in state for t in inputs], np.float64)


@pytest.mark.parametrize("spec", SPECS, ids=("discrete", "vectors"))
def test_the_readout_is_ridge_regression_and_its_loss_a_gaussian_one(spec):
    seen = decisions(spec, 40, seed=0)
    model = OutcomeModel.fit(spec, iter(seen), decisions(spec, 40, seed=1))
    x = np.stack([features_of(spec, one, row) for one in seen for row in range(B)])
    y = np.stack([outcome_of(spec, one, row) for one in seen for row in range(B)])
    pull = np.sqrt(1e-3 * np.mean(np.square(x)) * len(x)) * np.eye(x.shape[1])
    slow = np.linalg.lstsq(np.concatenate([x, pull]), np.concatenate([y, np.zeros((x.shape[1], y.shape[1]))]), rcond=None)[0]
    np.testing.assert_allclose(model.readout, slow, atol=2e-4)
    left = np.sqrt(np.mean((y - x @ slow) ** 2, axis=0))
    np.testing.assert_allclose(model.deviation, left, rtol=1e-3)
    assert (left < 0.6 * y.std(axis=0)).all(), "the readout predicts nothing, so this would prove little"
    other = decisions(spec, 1, seed=2)[0]
    for row, loss in enumerate(model.loss(spec, other)):
        error = (outcome_of(spec, other, row) - features_of(spec, other, row) @ slow) / left
        assert loss == pytest.approx(np.mean(0.5 * error**2), rel=1e-2)


def test_surprise_is_0_at_the_median_and_1_at_the_rare_quantile_of_held_out_windows():
    spec, steps = SPECS[0], 60
    model = OutcomeModel.fit(spec, decisions(spec, 200, seed=0), apart := decisions(spec, steps, seed=1))
    losses = np.stack([model.loss(spec, one) for one in apart], axis=1)
    for number, length in enumerate(WINDOWS):
        fits = max(w for w in WINDOWS if w <= min(length, steps))
        means = [losses[row, end - fits : end].mean() for row in range(B) for end in range(fits, steps + 1)]
        np.testing.assert_allclose(model.typical[number], np.quantile(means, 0.5), rtol=1e-5)
        np.testing.assert_allclose(model.rare[number], np.quantile(means, RARE), rtol=1e-5)
    for seen in range(1, steps + 1):
        number = max(n for n, length in enumerate(WINDOWS) if length <= seen)
        recent = losses[:, seen - WINDOWS[number] : seen].mean(axis=1)
        expected = (recent - model.typical[number]) / (model.rare[number] - model.typical[number])
        np.testing.assert_allclose(model.surprise(losses[:, :seen]), expected, rtol=1e-4, atol=1e-4)


def test_the_running_surprise_keeps_the_longest_window_and_no_more():
    spec = SPECS[0]
    model = OutcomeModel.fit(spec, decisions(spec, 200, seed=0), decisions(spec, 120, seed=1))
    running = Surprise(model, spec, B)
    np.testing.assert_array_equal(running.score(), np.zeros(B))
    for one in decisions(spec, 30, seed=3, noise=3.0):
        running.observe(*one)
    assert running.score().min() > 3
    calm = decisions(spec, WINDOWS[-1], seed=4)
    for one in calm:
        running.observe(*one)
    np.testing.assert_allclose(running.score(), model.surprise(np.stack([model.loss(spec, one) for one in calm], axis=1)))
    assert np.median(running.score()) < 1


def test_a_change_of_a_constant_of_training_gives_a_high_surprise():
    spec = SPECS[0]
    still = [(s, o, a, r * 0, o) for s, o, a, r, _ in decisions(spec, 50, seed=0)]
    model = OutcomeModel.fit(spec, still, still)
    state, before, action, reward, after = decisions(spec, 1, seed=1)[0]
    assert np.isfinite(model.loss(spec, (state, before, action, reward, after))).all()
    assert model.surprise(model.loss(spec, (state, before, action, reward, after))[:, None]).min() > 100


@pytest.fixture
def untrained(small_run):
    """An untrained model of ``small_run``."""
    torch.manual_seed(0)
    spec, method = registry.of(small_run).spec, methods.of(small_run)
    return TrainedModel(small_run, method, spec, method.build(spec, small_run).eval())


def test_calibration_deploys_in_training_tasks_under_new_adversaries_and_repeats(small_run, untrained):
    reported = list[int]()
    once, again = ood_score.calibrate(untrained, reported.append), ood_score.calibrate(untrained)
    assert reported == list(range(1, 2 * ood_score.EPISODES + 1))
    for name, array in once.arrays().items():
        np.testing.assert_array_equal(array, again.arrays()[name])
    rows, train = list(ood_score._rows(untrained)), registry.of(small_run).split.train
    assert {index for index, _ in rows} == set(range(len(train)))
    goals = {task["goal"] for task in train}
    assert {variation.task["goal"] for _, variation in rows} == goals
    trained_on = {v.adversary for i, task in enumerate(train) for v in registry.training_variations(small_run, i, task)}
    assert {variation.adversary for _, variation in rows} & trained_on <= {NULL}


def test_each_method_is_calibrated_under_the_disturbances_that_it_trains_on(small_run):
    task = registry.of(small_run).split.train[0]
    undisturbed = ("ad", "dpt", "ic2rl", "mix_dpt", "prompt_dt", "qarl", "rarl")
    for name in methods.names():
        method = methods.of(dataclasses.replace(small_run, method=name))
        trained_on = {v.adversary.kind for v in method.training_variations(small_run, 0, task, 5)}
        assert trained_on == ({"null"} if name in undisturbed else {"null", "dirichlet"})


class Mirrored:
    """Controls that were never trained on: +x moves to -x and back, +y to +x, and so on."""

    def __init__(self, inner):
        self.spec, self.batch, self.reset, self._inner = inner.spec, inner.batch, inner.reset, inner

    def step(self, actions):
        return self._inner.step(np.array([3, 2, 0, 1, 4])[actions])


def deployed(agent, env, episodes=2):
    """Surprise after each episode."""
    agent.reset_context(env.batch)
    found = []
    for number in range(episodes):
        obs = env.reset([np.random.default_rng((number, row)) for row in range(env.batch)])
        for _ in range(env.spec.horizon):
            action = agent.act(obs)
            step = env.step(action)
            agent.observe(obs, action, step.reward, step.observation, np.full(env.batch, step.done))
            obs = step.observation
        found.append(agent.surprise)
    return np.stack(found)


@pytest.mark.integration
def test_surprise_rises_on_an_unseen_kind_of_disturbance_and_not_on_unseen_goals():
    """The shipped agent on goals that were used neither in training nor in calibration."""
    agent = load_agent("darkroom", seed=0)
    run = parse(load_checkpoint(shipped("darkroom")).manifest["run"], "shipped")
    np.testing.assert_array_equal(agent.surprise, [0.0])
    usual = deployed(agent, registry.batch(evaluate.variations(run, 0.1)))
    strange = deployed(agent, Mirrored(registry.batch(evaluate.variations(run, 0.1))))
    stronger = deployed(agent, registry.batch(evaluate.variations(run, 0.6)))
    assert usual.shape == (2, 20) and np.mean(usual > 1) <= 0.1
    assert np.mean(strange > 1) >= 0.95 and np.median(strange) > 2
    assert np.median(usual) < 0.5 < 1 < np.median(stronger) < np.median(strange) + 3
    agent.reset_context(2)
    np.testing.assert_array_equal(agent.surprise, [0.0, 0.0])


def test_only_transitions_after_an_act_count(untrained):
    agent = InContextAgent(untrained, {}, 0, outcomes=ood_score.calibrate(untrained))
    obs = np.zeros((1, 2), np.float32)
    agent.observe(obs, [0], [1.0], obs, [False])
    np.testing.assert_array_equal(agent.surprise, [0.0])
    agent.observe(obs, agent.act(obs), [1.0], obs, [False])
    first = agent.surprise
    assert first != 0.0
    agent.observe(obs, [0], [1.0], obs, [False])
    np.testing.assert_array_equal(agent.surprise, first)


def test_surprise_of_an_uncalibrated_agent_is_refused_and_export_calibrates_it(small_run, untrained, tmp_path):
    from learner import checkpoints

    file = tmp_path / "version-0000.npz"
    arrays = {f"model/{name}": value.numpy() for name, value in untrained.model.state_dict().items()}
    save_checkpoint(file, Checkpoint(arrays, checkpoints.manifest(small_run, untrained.spec, 0, 1)))
    with pytest.raises(ConfigError, match=r"not calibrated.*icrl-dist export"):
        _ = load_agent(file).surprise
    assert main.main(["export", str(file), "--out", str(tmp_path / "agent.npz")]) == 0
    exported = load_checkpoint(tmp_path / "agent.npz")
    assert load_agent(tmp_path / "agent.npz").surprise.shape == (1,)
    assert calibrated(exported) is exported
    expected = ood_score.calibrate(trained(exported)).arrays()
    for name, array in exported.part("outcomes").items():
        np.testing.assert_array_equal(array, expected[name])
    broken = Checkpoint({**exported.arrays, "outcomes/more": np.zeros(1)}, exported.manifest)
    with pytest.raises(StoreError, match="not calibrated by this version"):
        outcomes_of(broken)


def test_a_spread_is_the_median_and_the_share_above_1():
    scores = np.array([[[np.nan, 0.0], [np.nan, 0.5]], [[np.nan, 1.5], [np.nan, 3.0]]])
    rows = frame(block(np.zeros((2, 2, 2)), p=0.2, surprise=scores.ravel()), block(np.zeros((2, 2, 2)), "random", 0.2))
    assert summaries.surprise(rows) == {"0.2": {"median": 1.0, "above_1": 0.5}}
