"""Every game against the contract battery, and the registry of games."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from icrl_dist import envs
from icrl_dist.envs import darkroom, network, pick_place, problems
from icrl_dist.types import Adversary, Task, Variation
from tests.contracts.game_battery import BATTERY, MakeVariation, an_unseeded_reset_goes_on


def disturbed_room() -> Variation:
    return Variation(darkroom.task((1, 2), 4, 20), Adversary.of("dirichlet", p=0.3, alpha=[0.1, 1.0, 0.5, 2.0, 0.3]))


def quiet_room() -> Variation:
    return Variation(darkroom.task((3, 0), 4, 6))


def pushed(kind: str) -> Callable[[], Variation]:
    """A problem of DeepMind Control, in short episodes, pushed by a fixed network."""

    def make() -> Variation:
        task = problems.grid(kind, 2)[1].replace(horizon=12)
        forces = problems.problem(kind).forces["paper"].count
        return Variation(task, network.network(1, envs.spec(task).observation, forces))

    make.__name__ = kind
    return make


def blurred_reach() -> Variation:
    """Meta-World's pick-place, seen through a fixed network."""
    task = pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2), horizon=12)
    return Variation(task, network.network(1, 39, pick_place.MOVED))


GAMES = [disturbed_room, quiet_room, blurred_reach, *map(pushed, problems.PROBLEMS)]


@pytest.mark.parametrize("make_variation", GAMES, ids=lambda make: make.__name__)
@pytest.mark.parametrize("law", BATTERY)
def test_contract(law: Callable[[MakeVariation], None], make_variation: MakeVariation) -> None:
    if law is an_unseeded_reset_goes_on and make_variation is blurred_reach:
        pytest.skip("a task of Meta-World begins always alike: nothing in an episode is drawn but the actions")
    law(make_variation)


def test_make_shows_the_override_in_info_only() -> None:
    variation = Variation(darkroom.task((0, 0), 3, 50), Adversary.of("dirichlet", p=0.5, alpha=[1.0] * 5))
    env, batch = envs.make(variation), envs.batch([variation])
    env.reset(seed=0)
    logged = [env.step(np.int64(4))[4]["adversary"] for _ in range(50)]
    batch.reset([np.random.default_rng(np.random.SeedSequence(0))])
    assert logged == [int(batch.step(np.array([4])).adversary[0]) for _ in range(50)]
    assert set(logged) == {-1, 0, 1, 2, 3, 4}


def test_unknown_problem_is_refused_with_the_known_ones() -> None:
    strange = Task.of("lightroom", size=3)
    with pytest.raises(ValueError, match=r"'lightroom'.*darkroom"):
        envs.spec(strange)
    with pytest.raises(ValueError, match=r"'lightroom'.*darkroom"):
        envs.batch([Variation(strange)])


def test_a_batch_of_two_problems_is_refused() -> None:
    with pytest.raises(ValueError, match=r"darkroom.*lightroom"):
        envs.batch([quiet_room(), Variation(Task.of("lightroom", size=3))])
    with pytest.raises(ValueError, match="one problem"):
        envs.batch([])
