"""The DeepMind Control problems against dm_control itself, and refused tasks and adversaries."""

import math
import os

import mujoco
import numpy as np
import pytest

from icrl_dist.problems import registry
from icrl_dist.problems.continuous import network_adversary
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.dmc import domains, simulation
from icrl_dist.types import NULL, Adversary, Spec, Task, Variation
from tests.optional import known

KINDS = tuple(domains.PROBLEMS)
STEPS = 200


def corner(kind, which):
    """A task at a corner of the problem's grid."""
    one, other = domains.problem(kind).parameters
    return domains.task(kind, **{one.name: (one.low, one.high)[which], other.name: (other.low, other.high)[1 - which]})


def reference(kind, task, seed):
    """dm_control's own environment with the task's parameters, set here a second time by name."""
    os.environ.setdefault("MUJOCO_GL", "disabled")
    from dm_control import suite

    _, domain, name = kind.split("-")
    env = suite.load(domain, name, task_kwargs={"random": np.random.RandomState(seed)})
    model = env.physics.named.model
    body = {"pole_mass": "pole_1", "cart_mass": "cart", "torso_mass": "torso", "arm_mass": "arm", "hand_mass": "hand"}
    for parameter, value in task.params:
        if parameter == "friction":
            model.geom_friction[:, 0] = value
        else:
            model.body_inertia[body[parameter]] *= value / model.body_mass[body[parameter]]
            model.body_mass[body[parameter]] = value
    mujoco.mj_setConst(env.physics.model.ptr, env.physics.data.ptr)
    return env


def flat(observation):
    return np.concatenate([np.ravel(part) for part in observation.values()])


PUSHED = {
    "cartpole": [("pole_1", "xz")],
    "cheetah": [("torso", "xz"), ("bfoot", "xz"), ("ffoot", "xz")],
    "hopper": [("torso", "xz"), ("foot", "xz")],
    "quadruped": [("torso", "xyz")],
    "reacher": [("arm", "xy")],
    "walker": [("right_foot", "xz"), ("left_foot", "xz")],
}
LARGEST = {"cartpole": 0.005, "cheetah": 1.0, "hopper": 1.0, "quadruped": 10.0, "reacher": 0.1, "walker": 1.0}
"""A second copy of Table 2."""


@pytest.mark.parametrize("kind", KINDS)
def test_every_step_is_dm_controls_own_forces_included(kind):
    domain, rng = kind.split("-")[1], np.random.default_rng(7)
    tasks = [corner(kind, 0), corner(kind, 1)]
    game = simulation.DMC(tasks)
    rngs = [np.random.default_rng(row) for row in range(2)]
    theirs = [reference(kind, task, int(np.random.default_rng(row).integers(2**32))) for row, task in enumerate(tasks)]
    shown = game.reset(rngs)
    low, high = np.array(game.spec.low, np.float32), np.array(game.spec.high, np.float32)
    for row, env in enumerate(theirs):
        np.testing.assert_array_equal(shown[row], np.clip(np.float32(flat(env.reset().observation)), low, high))
    paid = 0.0
    for _ in range(STEPS):
        actions = rng.uniform(-1, 1, (2, game.spec.actions)).astype(np.float32)
        pushes = rng.uniform(-1, 1, (2, game.disturbance)).astype(np.float32)
        step = game.step(actions, pushes)
        for row, env in enumerate(theirs):
            left = list(pushes[row])
            for body, axes in PUSHED[domain]:
                for axis in axes:
                    env.physics.named.data.xfrc_applied[body, "xyz".index(axis)] = left.pop(0) * np.float32(LARGEST[domain])
            theirs_now = env.step(actions[row])
            expected = np.clip(np.float32(flat(theirs_now.observation)), low, high)
            np.testing.assert_allclose(step.observation[row], expected, rtol=1e-6, atol=1e-6)
            assert step.reward[row] == pytest.approx(theirs_now.reward, abs=1e-6)
            paid += theirs_now.reward
    assert step.done and not known(step.diverged).any()
    assert paid > 0 or domain in ("hopper", "reacher"), "no reward was compared"


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_are_table_2s(kind):
    domain = kind.split("-")[1]
    sizes = {
        "cartpole": (5, 1),
        "cheetah": (17, 6),
        "hopper": (15, 4),
        "quadruped": (78, 12),
        "reacher": (6, 2),
        "walker": (24, 6),
    }
    spec = registry.spec(domains.task(kind))
    assert (spec.observation, spec.actions) == sizes[domain]
    assert (spec.horizon, spec.discrete) == (200, False)
    assert domains.problem(kind).forces["paper"].count == sum(len(axes) for _, axes in PUSHED[domain])
    assert domains.problem(kind).forces["paper"].largest == LARGEST[domain]


def test_there_are_11_problems_in_6_domains():
    assert len(KINDS) == 11 and len({kind.split("-")[1] for kind in KINDS}) == 6


@pytest.mark.parametrize("kind", ["dmc-hopper-hop", "dmc-reacher-easy"])
def test_a_row_does_not_depend_on_the_other_rows(kind):
    tasks = domains.grid(kind, 2)
    adversaries = [
        NULL,
        *(network_adversary.network(seed, registry.spec(tasks[0]).observation, envs_forces(kind)) for seed in range(3)),
    ]
    rows = [Variation(task, adversary) for task, adversary in zip(tasks, adversaries, strict=True)]
    together, single = registry.batch(rows), registry.batch(rows[2:3])
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 4, together.spec.actions)).astype(np.float32)
    seen = [together.reset([np.random.default_rng(row) for row in range(4)])]
    of_single = [single.reset([np.random.default_rng(2)])]
    for now in actions:
        seen.append(together.step(now).observation)
        of_single.append(single.step(now[2:3]).observation)
    np.testing.assert_array_equal(np.stack(seen)[:, 2], np.stack(of_single)[:, 0])


def envs_forces(kind):
    return domains.problem(kind).forces["paper"].count


def test_the_adversary_acts_on_the_observation_and_its_action_is_recorded():
    kind = "dmc-cheetah-run"
    adversary = network_adversary.network(5, 17, 6, strength=2.0)
    env = registry.batch([Variation(domains.task(kind), adversary), Variation(domains.task(kind))])
    nets = Networks([adversary], env.spec, 6)
    shown, moved = env.reset([np.random.default_rng(0)] * 2), 0.0
    for _ in range(30):
        step = env.step(np.zeros((2, 6), np.float32))
        np.testing.assert_array_equal(step.adversary[0], nets.act(shown[:1])[0])
        np.testing.assert_array_equal(step.adversary[1], np.zeros(6))
        shown = step.observation
        moved = max(moved, np.abs(step.adversary[0]).max())
    assert 0.5 < moved <= 2.0
    assert np.abs(shown[0] - shown[1]).max() > 1e-3, "the force changed nothing"


def test_a_network_is_rebuilt_bit_for_bit_and_equals_a_slow_loop():
    spec = Spec((-2.0, 0.0), (2.0, 10.0), 1, 5, discrete=False)
    one, other = network_adversary.network(3, 2, 4, 0.5), network_adversary.network(4, 2, 4)
    for mine, again in zip(
        network_adversary.weights(one), network_adversary.weights(Adversary(one.kind, one.params)), strict=True
    ):
        assert mine.tobytes() == again.tobytes()
    assert network_adversary.weights(one)[0].tobytes() != network_adversary.weights(other)[0].tobytes()
    shown = np.array([[1.0, 7.0], [0.5, 2.0], [-2.0, 10.0]], np.float32)
    answers = Networks([one, NULL, other], spec, 4).act(shown)
    for row, adversary in ((0, one), (2, other)):
        layers = network_adversary.weights(adversary)
        x = [shown[row][0] / 2, (shown[row][1] - 5) / 5]
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            x = [
                math.tanh(sum(a * w for a, w in zip(x, column, strict=True)) + b)
                for column, b in zip(weight.T, bias, strict=True)
            ]
        np.testing.assert_allclose(answers[row], np.array(x) * adversary.number("strength"), atol=1e-5)
    np.testing.assert_array_equal(answers[1], np.zeros(4))


def test_networks_of_a_task_are_k_disturbances_and_no_null_adversary():
    spec = registry.spec(domains.task("dmc-walker-run"))
    made = network_adversary.networks(np.random.default_rng(0), 5, spec, 4, 1.0)
    assert len(set(made)) == 5 and {one.kind for one in made} == {"network"}
    assert made[:3] == network_adversary.networks(np.random.default_rng(0), 3, spec, 4, 1.0)
    assert made == network_adversary.networks(np.random.default_rng(0), 5, spec, 4, 1.0)


def masses(task, body):
    game = simulation.DMC([task])
    model = game._models[0]
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
    return model.body_mass[number], model.body_inertia[number].copy(), model.body_subtreemass[1]


def test_a_mass_changes_inertia_and_derived_constants_except_with_qarls_forces():
    kind = "dmc-cheetah-run"
    mass, inertia, whole = masses(domains.task(kind), "torso")
    heavy, rescaled, heavier = masses(domains.task(kind, torso_mass=9.0), "torso")
    assert heavy == 9.0 and heavier == pytest.approx(whole + 9.0 - mass)
    np.testing.assert_allclose(rescaled, inertia * 9.0 / mass)
    qarl, kept, same = masses(domains.task(kind, torso_mass=9.0, mass="qarl"), "torso")
    assert qarl == 9.0 and same == whole
    np.testing.assert_array_equal(kept, inertia)


@pytest.mark.parametrize("kind", KINDS)
def test_a_mass_does_not_change_what_cameras_clip_by(kind):
    """``mj_setConst`` also changes these two, for a walker from 2 m to 273 m: its image showed no robot."""
    ours, suites = (model.stat for model in (simulation.DMC([corner(kind, 1)])._models[0], plain_model(kind)))
    assert ours.extent == suites.extent and ours.center.tolist() == suites.center.tolist()


def plain_model(kind):
    return simulation.suite_environment(kind).physics.model.ptr


def test_friction_applies_to_every_geom():
    model = simulation.DMC([domains.task("dmc-cheetah-run", friction=0.3)])._models[0]
    np.testing.assert_array_equal(model.geom_friction[:, 0], 0.3)


def test_qarls_forces_are_a_preset():
    assert simulation.DMC([domains.task("dmc-hopper-hop", forces="qarl")]).disturbance == 2
    game = simulation.DMC([domains.task("dmc-quadruped-run", forces="qarl")])
    game.reset([np.random.default_rng(0)])
    game.step(np.zeros((1, 12), np.float32), np.array([[0.1, 0.2, 0.3]], np.float32))
    torso = mujoco.mj_name2id(game._models[0], mujoco.mjtObj.mjOBJ_BODY, "torso")
    np.testing.assert_allclose(game._data[0].xfrc_applied[torso], [1.0, 0, 2.0, 0, 3.0, 0], rtol=1e-6)


def test_the_grid_is_8_by_8_and_pretraining_has_its_center():
    kind = "dmc-walker-run"
    whole, middle = domains.grid(kind), domains.grid(kind, 4)
    assert (len(whole), len(middle)) == (64, 16) and set(middle) <= set(whole)
    masses, frictions = ({task.number(name) for task in whole} for name in ("torso_mass", "friction"))
    np.testing.assert_allclose(sorted(masses), np.linspace(5, 15, 8))
    assert {task.number("torso_mass") for task in middle} == set(sorted(masses)[2:6])
    assert {task.number("friction") for task in middle} == set(sorted(frictions)[2:6])
    with pytest.raises(ValueError, match=r"3x3.*even"):
        domains.grid(kind, 3)


def test_a_diverged_simulation_stands_still_without_reward_and_the_next_episode_is_complete(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of its warnings into the working folder
    game = simulation.DMC(domains.grid("dmc-cheetah-run", 2)[:2])
    nothing = np.zeros((2, 6), np.float32)
    game.reset([np.random.default_rng(row) for row in range(2)])
    before = game.step(nothing, nothing).observation
    game._data[1].qvel[:] = 1e12
    for number in range(2, 201):
        step = game.step(nothing, nothing)
        assert known(step.diverged).tolist() == [False, True] and step.reward[1] == 0
        np.testing.assert_array_equal(step.observation[1], before[1])
        assert np.isfinite(step.observation).all() and step.done == (number == 200)
    game.reset([np.random.default_rng(row) for row in range(2)])
    assert not known(game.step(nothing, nothing).diverged).any()


def test_a_diverged_episode_is_truncated_and_marked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = registry.make(Variation(domains.task("dmc-cartpole-balance")))
    env.reset(seed=0)
    assert env.step(np.zeros(1, np.float32))[3:] == (False, {"adversary": pytest.approx(np.zeros(2)), "diverged": False})
    assert isinstance(env._batch, simulation.DMCVariations)
    env._batch.simulation._data[0].qvel[:] = 1e12
    _, reward, terminated, truncated, info = env.step(np.zeros(1, np.float32))
    assert (reward, terminated, truncated, info["diverged"]) == (0.0, False, True, True)
    with pytest.raises(RuntimeError, match="broke down in this episode; call reset"):
        env.step(np.zeros(1, np.float32))
    env.reset()
    assert not env.step(np.zeros(1, np.float32))[4]["diverged"]


@pytest.mark.parametrize(
    "kind", ["dmc-cheetah-run", "dmc-hopper-stand", "dmc-quadruped-walk", "dmc-walker-walk", "dmc-cartpole-swingup"]
)
def test_extreme_actions_rarely_leave_the_range_of_an_observation(kind):
    game, rng = simulation.DMC(domains.grid(kind, 2)), np.random.default_rng(0)
    game.reset([np.random.default_rng(row) for row in range(4)])
    edge, high = [], np.array(game.spec.high, np.float32)
    for _ in range(STEPS):
        actions = rng.choice([-1.0, 1.0], (4, game.spec.actions)).astype(np.float32)
        step = game.step(actions, np.ones((4, game.disturbance), np.float32))
        edge.append(np.abs(step.observation) >= high * (1 - 1e-6))
    bounded = high > 1.0  # a cosine reaches 1
    assert np.stack(edge)[..., bounded].mean() < 0.003


def test_an_impossible_task_is_refused_with_the_remedy():
    for kind, settings, message in (
        ("dmc-cheeta-run", {}, "'dmc-cheeta-run'.*did you mean 'dmc-cheetah-run'"),
        ("dmc-cheetah-run", {"torso_mas": 5.0}, "'torso_mas'.*torso_mass"),
        ("dmc-cheetah-run", {"torso_mass": 20.0}, "torso_mass=20 lies outside its grid: use 3 to 9"),
        ("dmc-cheetah-run", {"friction": 0.0}, r"friction=0 lies outside.*0\.1 to 1\.9"),
        ("dmc-cheetah-run", {"forces": "strong"}, "forces='strong'.*paper, qarl"),
        ("dmc-cheetah-run", {"mass": "heavy"}, "mass='heavy'.*rescaled, qarl"),
        ("dmc-cheetah-run", {"horizon": 0}, "horizon=0"),
        ("dmc-cheetah-run", {"horizon": 1.5}, "horizon=1.5"),
    ):
        with pytest.raises(ValueError, match=message):
            domains.task(kind, **settings)
    with pytest.raises(ValueError, match=r"did you mean 'dmc-cheetah-run'"):
        registry.spec(Task.of("dmc-cheetah-rum"))


def test_variations_and_actions_that_do_not_fit_are_refused_with_the_remedy():
    cheetah, walker = domains.task("dmc-cheetah-run"), domains.task("dmc-walker-run")
    with pytest.raises(ValueError, match="one problem, horizon and preset"):
        simulation.DMC([cheetah, walker])
    for wrong in (Task.of("dmc-cheetah-run", torso_mass=1000.0), Task.of("dmc-cheetah-run", torso_mas=1.0)):
        with pytest.raises(ValueError, match="torso_mas"):
            simulation.DMC([cheetah, wrong])
    with pytest.raises(ValueError, match=r"5 inputs and 2 outputs: this problem has 17.*6 of disturbance"):
        registry.batch([Variation(cheetah, network_adversary.network(0, 5, 2))])
    with pytest.raises(ValueError, match=r"'dirichlet'.*null and network"):
        registry.batch([Variation(cheetah, Adversary.of("dirichlet", p=0.1, alpha=[1.0] * 5))])
    env = registry.batch([Variation(cheetah)])
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros((1, 6), np.float32))
    with pytest.raises(ValueError, match="2 generators for 1 rows"):
        env.reset([np.random.default_rng(0)] * 2)
    env.reset([np.random.default_rng(0)])
    for value in (1.1, np.nan):
        with pytest.raises(ValueError, match=r"numbers in \[-1, 1\]"):
            env.step(np.full((1, 6), value, np.float32))
