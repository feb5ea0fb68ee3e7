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


def test_hand_and_object_are_drawn_from_above():
    states = np.zeros((3, 39))
    states[:, :3], states[:, 4:7] = [0.1, 0.6, 0.2], [[0.0, 0.6, 0.02], [0.01, 0.65, 0.02], [0.02, 0.7, 0.02]]
    drawn = drawing.of(message("metaworld-pick-place", {"goal": [0.1, 0.8, 0.2], "object": [0.0, 0.6, 0.02]}, states))
    assert drawn["goal"] == [0.1, 0.8]
    assert drawn["paths"][0] == {"name": "hand", "points": [[0.1, 0.6]] * 3}
    assert drawn["paths"][1] == {"name": "object", "points": [[0.0, 0.6], [0.01, 0.65], [0.02, 0.7]]}


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
