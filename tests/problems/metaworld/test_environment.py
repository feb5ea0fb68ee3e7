"""Meta-World's pick-place: its own simulation, a goal that is hidden from the agent, and the reach of an adversary."""

import functools
import pickle

import numpy as np
import pytest

from icrl_dist.problems import registry
from icrl_dist.problems.continuous import network_adversary
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.metaworld import environment, pick_place
from icrl_dist.problems.metaworld.environment import PickPlace
from icrl_dist.types import NULL, Adversary, Variation
from tests.optional import known

TASK = pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2))
ADVERSARY = network_adversary.network(3, 39, 9)


@pytest.fixture(scope="module", autouse=True)
def anew():
    """Meta-World's ML1, made once for each seed, because it simulates all of its 50 tasks when it is made."""
    import metaworld

    anew = metaworld.ML1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metaworld, "ML1", functools.cache(anew))
        yield anew


@pytest.fixture(scope="module")
def ml1(anew):
    return environment.ml1_tasks(20, seed=0)


def rngs(count):
    return [np.random.default_rng(row) for row in range(count)]


def test_ml1s_first_20_tasks_are_its_own_and_fit_the_box(ml1, anew):
    theirs = [pickle.loads(one.data)["rand_vec"] for one in anew("pick-place-v3", seed=0).train_tasks[:20]]
    for task, vector in zip(ml1, theirs, strict=True):
        np.testing.assert_array_equal([*task.vector("object"), *task.vector("goal")], vector)
    assert len(set(ml1)) == 20 and ml1[:7] == environment.ml1_tasks(7, seed=0)
    assert environment.ml1_tasks(3, seed=1)[0] != ml1[0]
    with pytest.raises(ValueError, match=r"51 tasks: ML1 has 50"):
        environment.ml1_tasks(51)


def test_every_step_equals_meta_worlds(ml1):
    from metaworld import ML1

    suite = ML1("pick-place-v3", seed=0)
    theirs = suite.train_classes["pick-place-v3"]()
    theirs.set_task(suite.train_tasks[4])
    env = PickPlace([Variation(ml1[4]), Variation(ml1[5])])
    rng = np.random.default_rng(0)
    shown, expected = env.reset(rngs(2))[0], theirs.reset()[0]
    low, high = np.array(env.spec.low, np.float32), np.array(env.spec.high, np.float32)
    paid = 0.0
    for _ in range(120):
        np.testing.assert_array_equal(shown, np.clip(np.float32(expected), low, high))
        actions = rng.uniform(-1, 1, (2, 4)).astype(np.float32)
        step = env.step(actions)
        expected, reward, _, _, info = theirs.step(actions[0])
        shown = step.observation[0]
        assert step.reward[0] == np.float32(reward) and env.success[0] == bool(info["success"])
        paid += reward
    assert paid > 0


def run(env, choose):
    """Success anywhere in an episode, and the return, of every row."""
    shown, success, total = env.reset(rngs(env.batch)), np.zeros(env.batch, bool), 0.0
    for _ in range(env.spec.horizon):
        step = env.step(choose(env, shown))
        shown, success, total = step.observation, success | env.success, total + step.reward
    return success, total


def test_the_scripted_policy_needs_the_goal_that_is_hidden_from_the_agent(ml1):
    """Labels come from the true state; given the agent's observation, the same policy never succeeds."""
    env = PickPlace([Variation(task) for task in ml1[:2]])
    knowing, paid = run(env, lambda env, shown: environment.expert(env.truth))
    blind, poor = run(env, lambda env, shown: environment.expert(shown.astype(np.float64)))
    assert knowing.all() and not blind.any()
    assert paid.min() > 3000 > 1000 > poor.max()
    assert np.abs(environment.expert(env.truth)).max() <= 1


def test_an_adversary_moves_hand_and_object_by_a_centimeter_at_most_and_nothing_else():
    env = PickPlace([Variation(TASK, ADVERSARY), Variation(TASK)])
    net = Networks([ADVERSARY], env.spec, 9)
    shown, most = env.reset(rngs(2)), 0.0
    for number in range(40):
        truth = env.truth.astype(np.float32)
        offset = shown - np.where(np.arange(39) >= 36, 0, truth)
        moved = np.zeros(39, bool)
        moved[[0, 1, 2, 4, 5, 6]] = True
        now = np.arange(39) < 18
        assert np.abs(offset[0][moved]).max() <= 0.0101
        np.testing.assert_array_equal(offset[0][now & ~moved], 0)
        np.testing.assert_allclose(offset[0][moved], 0.01 * net.act(truth[:1])[0, :6], atol=1e-6)
        np.testing.assert_array_equal(offset[1][now], 0)
        np.testing.assert_array_equal(shown[:, 36:], 0)
        most = max(most, np.abs(offset[0][moved]).max())
        before, step = shown, env.step(np.zeros((2, 4), np.float32) + np.float32(0.3 if number % 2 else -0.2))
        shown = step.observation
        np.testing.assert_array_equal(shown[:, 18:36], before[:, :18])
        np.testing.assert_array_equal(step.adversary[1], 0)
        assert np.abs(step.adversary[0]).max() > 0
    assert most > 0.005


def test_the_first_observation_is_disturbed_too():
    env = PickPlace([Variation(TASK, ADVERSARY), Variation(TASK)])
    shown = env.reset(rngs(2))
    assert np.abs(shown[0, :3] - shown[1, :3]).max() > 1e-4
    np.testing.assert_array_equal(shown[:, 18:36], shown[:, :18])


def test_a_visible_goal_is_disturbed_too():
    task = TASK.replace(goal_shown=1, disturbance=0.02)
    env = PickPlace([Variation(task, ADVERSARY), Variation(task)])
    shown = env.reset(rngs(2))
    np.testing.assert_allclose(shown[1, 36:], [0.05, 0.85, 0.2], rtol=1e-6)
    away = np.abs(shown[0, 36:] - shown[1, 36:])
    assert 1e-4 < away.max() <= 0.0201
    np.testing.assert_array_equal(env.truth[:, 36:], np.array([[0.05, 0.85, 0.2]] * 2))


def test_a_diverged_simulation_stands_still_without_reward_and_the_next_episode_is_complete(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of its warnings into the working folder
    env, still = PickPlace([Variation(TASK), Variation(TASK)]), np.zeros((2, 4), np.float32)
    env.reset(rngs(2))
    env.step(still)
    before = env.truth[1].copy()
    env._envs[1].data.qvel[:] = 1e12
    for _ in range(3):
        step = env.step(still)
        assert known(step.diverged).tolist() == [False, True] and step.reward[1] == 0 < step.reward[0]
        np.testing.assert_array_equal(env.truth[1], before)
        assert np.isfinite(step.observation).all() and not env.success[1]
    env.reset(rngs(2))
    step = env.step(still)
    assert not known(step.diverged).any()
    np.testing.assert_array_equal(step.observation[0], step.observation[1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"object": (0.5, 0.65, 0.02)}, r"object=\(0\.5, 0\.65, 0\.02\) lies outside its box"),
        ({"goal": (0.0, 0.85)}, r"goal=\(0\.0, 0\.85\) lies outside"),
        ({"horizon": 501}, "horizon=501: expected 1 to 500"),
        ({"goal_shown": 2}, "goal_shown=2"),
        ({"disturbance": 1.0}, r"disturbance=1\.0: expected 0 to 0\.1 meters"),
        ({"goal_show": 1}, r"no parameter 'goal_show'.*did you mean 'goal_shown'"),
    ],
)
def test_an_impossible_task_is_refused(settings, message):
    given = {"object": (0.02, 0.65, 0.02), "goal": (0.05, 0.85, 0.2), **settings}
    with pytest.raises(ValueError, match=message):
        pick_place.task(given.pop("object"), given.pop("goal"), **given)


def test_variations_and_actions_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"17 inputs.*this problem has 39"):
        registry.batch([Variation(TASK, network_adversary.network(0, 17, 9))])
    with pytest.raises(ValueError, match="null and network"):
        registry.batch([Variation(TASK, Adversary.of("uniform", p=0.1))])
    with pytest.raises(ValueError, match="one horizon"):
        registry.batch([Variation(TASK), Variation(TASK.replace(goal_shown=1))])
    env = registry.batch([Variation(TASK, NULL)])
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros((1, 4), np.float32))
    with pytest.raises(ValueError, match="2 generators for 1 rows"):
        env.reset(rngs(2))
