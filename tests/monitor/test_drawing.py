"""Drawings: limbs are where MuJoCo places them, and paths follow hand and object."""

import mujoco
import numpy as np
import pytest

from icrl_dist.monitor import drawing
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.problems import registry
from icrl_dist.problems.dmc import domains, picture
from icrl_dist.problems.dmc.simulation import DMC
from icrl_dist.stream import validation
from icrl_dist.types import Variation
from tests.optional import known


@pytest.mark.parametrize(
    "kind",
    ["dmc-cartpole-swingup", "dmc-cheetah-run", "dmc-hopper-hop", "dmc-quadruped-walk", "dmc-reacher-hard", "dmc-walker-run"],
)
def test_limbs_are_drawn_where_the_simulation_places_them(kind):
    """Compares up to a common offset, because the position of the whole figure is not observed."""
    game = DMC([domains.task(kind)])
    state = game.reset([np.random.default_rng(3)])
    rng = np.random.default_rng(4)
    for _ in range(6):
        step = game.step(
            rng.uniform(-1, 1, (1, game.spec.actions)).astype(np.float32), np.zeros((1, game.disturbance), np.float32)
        )
        state = step.observation
    drawn = np.array(picture.sticks(kind, state)[0])
    model, data = game._models[0], game._data[0]
    mujoco.mj_kinematics(model, data)
    figure = picture.Figure(kind)
    expected = data.geom_xpos[figure._geoms][:, figure._view]
    if "quadruped" in kind:
        root = data.xmat[1].reshape(3, 3)
        expected = ((data.geom_xpos[figure._geoms] - data.xpos[1]) @ root)[:, :2]
    middles = ((drawn[:, :2] + drawn[:, 2:]) / 2)[: len(expected)]
    moved = expected - middles
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=3e-3)
    if "reacher" in kind:
        target = data.geom_xpos[model.geom("target").id][:2]
        np.testing.assert_allclose(drawn[-1, :2] + [0, 0.03], target, atol=3e-3)
        np.testing.assert_allclose(moved, 0, atol=3e-3)


def message(problem, task, states, **changes):
    states = np.asarray(states, np.float32)
    arrays = {
        "observations": validation.from_array(states),
        "adversary": validation.from_array(np.full(len(states), 0.5, np.float32)),
    }
    return {"problem": problem, "task": dict(task), "every": 2} | arrays | changes


def test_every_frame_has_a_force():
    drawn = drawing.of(message("dmc-cartpole-balance", {}, np.tile([0, 1, 0, 0, 0], (4, 1))))
    assert drawn["kind"] == "sticks" and drawn["force"] == [0.5] * 4 and drawn["frame_s"] == pytest.approx(0.02)
    cart, pole = drawn["frames"][0]
    assert pole[0] == pole[2] == 0.0 and abs(pole[3] - pole[1]) == pytest.approx(1.0, abs=1e-3), "upright, one meter long"
    assert cart[1] == cart[3]


def test_hand_gripper_and_object_of_an_arm_are_drawn():
    states = np.zeros((3, 39))
    states[:, :3], states[:, 3] = [0.1, 0.6, 0.2], [0.0, 0.5, 1.2]
    states[:, 4:7] = [[0.0, 0.6, 0.02], [0.01, 0.65, 0.02], [0.02, 0.7, 0.1]]
    drawn = drawing.of(message("metaworld-pick-place", {"goal": [0.1, 0.8, 0.2], "object": [0.0, 0.6, 0.02]}, states))
    assert drawn == {
        "kind": "arm",
        "hand": [[0.1, 0.6, 0.2]] * 3,
        "object": [[0.0, 0.6, 0.02], [0.01, 0.65, 0.02], [0.02, 0.7, 0.1]],
        "opening": [0.0, 0.5, 1.0],
        "goal": [0.1, 0.8, 0.2],
    }


@pytest.mark.parametrize("kind", ["dmc-cheetah-run", "dmc-hopper-hop", "dmc-walker-run"])
def test_the_travel_of_a_body_is_that_of_the_simulation(kind):
    game = DMC([domains.task(kind)])
    states = [game.reset([np.random.default_rng(3)])[0]]
    place, rng = int(game._models[0].joint("rootx").qposadr[0]), np.random.default_rng(4)
    positions = [game._data[0].qpos[place]]
    for _ in range(60):
        action = rng.uniform(-1, 1, (1, game.spec.actions)).astype(np.float32)
        states.append(game.step(action, np.zeros((1, game.disturbance), np.float32)).observation[0])
        positions.append(game._data[0].qpos[place])
    moved = np.array(positions) - positions[0]
    drawn = drawing.of(message(kind, {}, states) | {"every": 1})
    assert drawn["ground"] == 0.0 and np.abs(moved).max() > 0.02
    np.testing.assert_allclose(drawn["travel"], moved, atol=0.01 + 0.05 * np.abs(moved).max())
    skipped = drawing.of(message(kind, {}, states[::2]) | {"every": 2})
    np.testing.assert_allclose(skipped["travel"], moved[::2], atol=0.02 + 0.2 * np.abs(moved).max())


def test_a_body_that_stays_has_no_travel_and_no_ground_is_seen_from_above():
    for kind, components in (("dmc-cartpole-balance", 5), ("dmc-reacher-easy", 6)):
        drawn = drawing.of(message(kind, {}, np.zeros((4, components))))
        assert drawn["travel"] == [] and drawn["ground"] is None
    states = np.zeros((3, 78))
    states[:, 44] = 1.0
    drawn = drawing.of(message("dmc-quadruped-walk", {}, states) | {"every": 1})
    assert drawn["ground"] is None and drawn["travel"] == pytest.approx([0.0, 0.02, 0.04])


@pytest.mark.parametrize(
    "changes",
    [
        {"problem": "chess"},
        {"observations": [1, 2]},
        {"observations": ["<f4", [1, 1 << 40], b""]},
        {"task": {"goal": [9, 9], "size": 4}},
        {"task": {"goal": [1, 1], "size": 1 << 60}},
        {"task": {}},
        {"observations": validation.from_array(np.full((3, 2), np.nan, np.float32))},
        {"observations": validation.from_array(np.zeros((3, 7), np.float32))},
        {"observations": validation.from_array(np.zeros((0, 2), np.float32))},
    ],
)
def test_invalid_episodes_are_refused(changes):
    good = message("darkroom", {"goal": [1, 1], "size": 4}, np.zeros((3, 2)))
    assert drawing.of(good)["path"] == [[0, 0]] * 3
    with pytest.raises(InvalidMessageError):
        drawing.of(good | changes)


def test_the_optimum_is_computed_for_small_valid_rooms_only():
    task, adversary = {"goal": [1, 1], "size": 4, "horizon": 9}, {"kind": "null"}
    assert known(drawing.optimum("darkroom", task, adversary)) > 0
    for invalid in (
        {"size": 1000},
        {"horizon": 10**9},
        {"goal": [9, 9]},
        {"goal": "x"},
        {"start": [7, 7]},
        {"start": "x"},
        {"size": "4"},
    ):
        assert drawing.optimum("darkroom", task | invalid, adversary) is None
    assert drawing.optimum("darkroom", task, {"kind": "dirichlet", "p": 3.0}) is None
    assert drawing.optimum("dmc-cheetah-run", {}, {}) is None
    assert {registry.spec(Variation(domains.task("dmc-walker-run")).task).observation} == {24}


def test_a_broken_package_ends_no_view(install):
    install(problems={"broken": "no_such_module:It"})
    for problem in ("broken", "not-installed"):
        with pytest.raises(InvalidMessageError, match="schema"):
            drawing.of(message(problem, {}, np.zeros((4, 2))))
        assert drawing.optimum(problem, {}, {}) is None
