"""Environments of every problem against the contract battery, ``registry.make`` and ``registry.batch``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco  # noqa: F401 - at collection, because its first import starts a process
import numpy as np
import pytest

from icrl_dist.problems import registry
from icrl_dist.problems.continuous import network_adversary
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.types import Adversary, Task, Variation
from tests.contracts.game_battery import BATTERY, MakeVariation, an_unseeded_reset_continues_the_generator


def disturbed_room() -> Variation:
    return Variation(room.task((1, 2), 4, 20), Adversary.of("dirichlet", p=0.3, alpha=[0.1, 1.0, 0.5, 2.0, 0.3]))


def undisturbed_room() -> Variation:
    return Variation(room.task((3, 0), 4, 6))


def pushed(kind: str) -> Callable[[], Variation]:
    """A DeepMind Control problem in short episodes; a fixed network applies forces."""

    def make() -> Variation:
        task = domains.grid(kind, 2)[1].replace(horizon=12)
        forces = domains.problem(kind).forces["paper"].count
        return Variation(task, network_adversary.network(1, registry.spec(task).observation, forces))

    make.__name__ = kind
    return make


def noisy_pick_place() -> Variation:
    """Meta-World's pick-place; a fixed network disturbs its observations."""
    task = pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2), horizon=12)
    return Variation(task, network_adversary.network(1, 39, pick_place.MOVED))


ENVIRONMENTS = [disturbed_room, undisturbed_room, noisy_pick_place, *map(pushed, domains.PROBLEMS)]


@pytest.mark.parametrize("make_variation", ENVIRONMENTS, ids=lambda make: make.__name__)
@pytest.mark.parametrize("check", BATTERY)
def test_contract(check: Callable[[MakeVariation], None], make_variation: MakeVariation) -> None:
    if check is an_unseeded_reset_continues_the_generator and make_variation is noisy_pick_place:
        pytest.skip("a Meta-World task always starts in the same state: only actions are drawn in an episode")
    check(make_variation)


def test_make_shows_the_override_in_info_alone() -> None:
    variation = Variation(room.task((0, 0), 3, 50), Adversary.of("dirichlet", p=0.5, alpha=[1.0] * 5))
    env, batch = registry.make(variation), registry.batch([variation])
    env.reset(seed=0)
    logged = [env.step(np.int64(4))[4]["adversary"] for _ in range(50)]
    batch.reset([np.random.default_rng(np.random.SeedSequence(0))])
    assert logged == [int(batch.step(np.array([4])).adversary[0]) for _ in range(50)]
    assert set(logged) == {-1, 0, 1, 2, 3, 4}


def test_unknown_problem_is_refused_with_the_known_ones() -> None:
    strange = Task.of("lightroom", size=3)
    with pytest.raises(ValueError, match=r"'lightroom'.*darkroom"):
        registry.spec(strange)
    with pytest.raises(ValueError, match=r"'lightroom'.*darkroom"):
        registry.batch([Variation(strange)])


def test_a_batch_of_two_problems_is_refused() -> None:
    with pytest.raises(ValueError, match=r"darkroom.*lightroom"):
        registry.batch([undisturbed_room(), Variation(Task.of("lightroom", size=3))])
    with pytest.raises(ValueError, match="one problem"):
        registry.batch([])


def test_a_room_is_drawn_from_above() -> None:
    env = registry.make(Variation(room.task((2, 0), 3, 5, start=(0, 1))), "rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image is not None and image.shape == (72, 72, 3) and image.dtype == np.uint8
    cells = image[12::24, 12::24]
    green = np.argwhere((cells == (45, 164, 78)).all(axis=2)).tolist()
    blue = np.argwhere((cells == (31, 111, 235)).all(axis=2)).tolist()
    assert (green, blue) == ([[2, 2]], [[1, 0]]), "rows from above, columns from the left"
    assert registry.make(undisturbed_room()).render() is None
    with pytest.raises(ValueError, match=r"render_mode 'human'.*'rgb_array'"):
        registry.make(undisturbed_room(), "human")


@pytest.mark.parametrize("make_variation", [noisy_pick_place, pushed("dmc-hopper-hop")], ids=["metaworld", "dmc"])
@pytest.mark.parametrize("back_end", ["disabled", "osmesa"])
def test_a_failed_rendering_is_one_line_with_the_remedy(
    make_variation: MakeVariation, back_end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env: Any = registry.make(make_variation(), "rgb_array")
    env.reset(seed=0)
    monkeypatch.setenv("MUJOCO_GL", back_end)
    inner = env._batch._envs[0] if make_variation is noisy_pick_place else env._batch.simulation._envs[0].physics

    def broken(*arguments: Any, **options: Any) -> None:
        raise OSError("no such\nlibrary")

    monkeypatch.setattr(inner, "render", broken)
    with pytest.raises(RuntimeError, match=f"MUJOCO_GL='{back_end}'.*set MUJOCO_GL=egl") as caught:
        env.render()
    assert len(str(caught.value).splitlines()) == 1
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(inner, "render", lambda *arguments, **options: np.ones((2, 3, 3), np.uint8))
    np.testing.assert_array_equal(env.render(), np.ones((2, 3, 3)))
