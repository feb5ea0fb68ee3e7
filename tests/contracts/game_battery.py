"""Requirements on the environments of every problem; ``tests/problems/test_gym_adapter.py`` runs them.

Each check takes ``make_variation``, which makes one variation of the problem anew.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from icrl_dist.problems import registry
from icrl_dist.problems.gym_adapter import VariationEnv
from icrl_dist.types import Variation

MakeVariation = Callable[[], Variation]

# ``make`` returns the environment itself and registers nothing with gymnasium.
HARMLESS = ("Not able to test alternative render modes",)


def _episode(env: VariationEnv, seed: int) -> list[Any]:
    """All observations and results of one episode of seeded random actions."""
    env.action_space.seed(seed)
    seen: list[Any] = [env.reset(seed=seed)[0].tobytes()]
    for _ in range(registry.spec(env.variation.task).horizon):
        observation, *rest, info = env.step(env.action_space.sample())
        seen.append((observation.tobytes(), *rest, {name: np.asarray(value).tolist() for name, value in info.items()}))
    return seen


def gymnasium_contract(make_variation: MakeVariation) -> None:
    """gymnasium's own checker gives no warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(registry.make(make_variation()))
    unexpected = [str(w.message) for w in caught if not any(text in str(w.message) for text in HARMLESS)]
    assert unexpected == []


def spec_agrees_with_spaces(make_variation: MakeVariation) -> None:
    variation = make_variation()
    env, spec = registry.make(variation), registry.spec(variation.task)
    box = env.observation_space
    assert isinstance(box, spaces.Box)
    assert box.dtype == np.float32
    np.testing.assert_array_equal(box.low, np.array(spec.low, np.float32))
    np.testing.assert_array_equal(box.high, np.array(spec.high, np.float32))
    assert spec.observation == len(spec.high) == box.shape[0]
    if spec.discrete:
        assert isinstance(env.action_space, spaces.Discrete)
        assert (env.action_space.start, env.action_space.n) == (0, spec.actions)
    else:
        assert env.action_space.shape == (spec.actions,)


def observations_lie_in_the_space(make_variation: MakeVariation) -> None:
    env = registry.make(make_variation())
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    for _ in range(registry.spec(env.variation.task).horizon):
        observation = env.step(env.action_space.sample())[0]
        assert env.observation_space.contains(observation), observation


def same_seed_same_episode(make_variation: MakeVariation) -> None:
    """In the same environment, in another one, and after any number of episodes."""
    one, other = registry.make(make_variation()), registry.make(make_variation())
    first = _episode(one, 3)
    assert _episode(one, 3) == first
    _episode(other, 4)
    assert _episode(other, 3) == first


def seeds_matter(make_variation: MakeVariation) -> None:
    env = registry.make(make_variation())
    assert len({str(_episode(env, seed)) for seed in range(5)}) == 5


def an_unseeded_reset_continues_the_generator(make_variation: MakeVariation) -> None:
    """reset() without a seed continues the generator and does not repeat the episode."""
    env = registry.make(make_variation())
    actions = [env.action_space.sample() for _ in range(registry.spec(env.variation.task).horizon)]
    env.reset(seed=0)
    episodes = set()
    for _ in range(4):
        observation, _ = env.reset()
        episodes.add((observation.tobytes(), *(env.step(a)[0].tobytes() for a in actions)))
    assert len(episodes) > 1


def truncated_exactly_at_the_horizon(make_variation: MakeVariation) -> None:
    """Episodes never terminate earlier; one more step is refused, and a reset allows the next episode."""
    env = registry.make(make_variation())
    env.action_space.seed(0)
    horizon = registry.spec(env.variation.task).horizon
    for _ in range(2):
        env.reset(seed=1)
        ends = [env.step(env.action_space.sample())[2:4] for _ in range(horizon)]
        assert ends == [(False, False)] * (horizon - 1) + [(False, True)]
        with pytest.raises(RuntimeError, match=f"horizon of {horizon}.*reset"):
            env.step(env.action_space.sample())


def a_step_before_reset_is_refused(make_variation: MakeVariation) -> None:
    env = registry.make(make_variation())
    with pytest.raises(RuntimeError, match="reset"):
        env.step(env.action_space.sample())


def an_action_outside_the_space_is_refused(make_variation: MakeVariation) -> None:
    variation = make_variation()
    env, spec = registry.make(variation), registry.spec(variation.task)
    env.reset(seed=0)
    wrong: list[Any] = [np.int64(-1), np.int64(spec.actions)] if spec.discrete else [np.full(spec.actions, 1e3, np.float32)]
    for action in wrong:
        with pytest.raises(ValueError, match="action"):
            env.step(action)


BATTERY: tuple[Callable[[MakeVariation], None], ...] = (
    gymnasium_contract,
    spec_agrees_with_spaces,
    observations_lie_in_the_space,
    same_seed_same_episode,
    seeds_matter,
    an_unseeded_reset_continues_the_generator,
    truncated_exactly_at_the_horizon,
    a_step_before_reset_is_refused,
    an_action_outside_the_space_is_refused,
)
