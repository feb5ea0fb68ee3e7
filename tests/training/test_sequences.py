"""Returns-to-go, and the windows and prompts of decision transformers, against slow loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrl_dist.models.segments import Segments, returns_to_go
from icrl_dist.training.sequences import Drawn, Histories, draw

H, W, P = 7, 4, 3


def histories(episodes: int, seed: int = 0, vectors: bool = False) -> Histories:
    """Episodes whose observation is (number of the episode, number of the step), so that each step can be recognized."""
    rng = np.random.default_rng(seed)
    places = np.stack(np.meshgrid(np.arange(episodes), np.arange(H + 1), indexing="ij"), axis=-1)
    rewards = rng.normal(size=(episodes, H)).astype(np.float32)
    drawn = rng.uniform(-1, 1, (episodes, H, 2)) if vectors else rng.integers(0, 2, (episodes, H))
    actions = drawn.astype(np.float32 if vectors else np.int16)
    made = Histories.made(actions, places.astype(np.float32), rewards, np.full((episodes, H), -1, np.int16))
    return replace(made, to_go=100 + made.observed)


def test_returns_to_go_are_the_sums_of_the_rewards_that_follow() -> None:
    rewards = np.random.default_rng(0).normal(size=(3, 5)).astype(np.float32)
    slow = [[sum(float(r) for r in row[h:]) for h in range(5)] for row in rewards]
    np.testing.assert_allclose(returns_to_go(rewards), slow, rtol=1e-6)
    np.testing.assert_array_equal(returns_to_go(np.array([0, 1, 0, 2], np.float32)), [3, 3, 2, 2])


@pytest.mark.parametrize("vectors", [False, True])
def test_a_segment_holds_the_steps_of_its_episode_and_marks_what_lies_outside(vectors: bool) -> None:
    found = histories(3, vectors=vectors)
    for first in range(1 - W, H + 1):
        cut = found.cut(found.to_go, np.array([2]), np.array([first]), W)
        expected = [h for h in range(first, first + W) if 0 <= h < H]
        count = len(expected)
        assert cut.valid[0].tolist() == [True] * count + [False] * (W - count)
        assert cut.steps[0, :count].tolist() == expected
        assert cut.observations[0, :count].tolist() == [[2, h] for h in expected]
        np.testing.assert_array_equal(cut.actions[0, :count], found.actions[2, expected])
        np.testing.assert_array_equal(cut.to_go[0, :count], found.to_go[2, expected])
        assert not any(column[0, count:].any() for column in cut)


def drawn(variations: list[Histories], dropout: float = 0.0, count: int = 400) -> tuple[Segments, Segments]:
    made = draw(np.random.default_rng(1), variations, Drawn(count, 3, W, P, dropout), 5.0, 7.0)
    assert (made.target, made.scale) == (5.0, 7.0) and len(made.prompt.valid) == len(made.window.valid) == 3 * count
    return made.prompt, made.window


def test_every_step_is_in_equally_many_windows() -> None:
    _, window = drawn([histories(4)], count=800)
    counts = np.bincount(window.steps[window.valid], minlength=H)
    expected = 3 * 800 * W / (H + W - 1)
    assert len(counts) == H and (abs(counts - expected) < 5 * np.sqrt(expected)).all(), counts
    assert 0 < window.actions[window.valid].mean() < 1, "action 0 is not padding"


def test_a_prompt_is_of_another_episode_of_the_same_variation_and_holds_observed_returns() -> None:
    first, second = histories(4, seed=1), histories(5, seed=2)
    prompt, window = drawn([first, second])
    assert prompt.valid.all()
    assert (prompt.observations[:, 0, 0] != window.observations[:, 0, 0]).all()
    assert set(prompt.steps[:, 0]) == set(range(H - P + 1))
    for row in range(len(prompt.valid)):
        assert any(
            (one.observed[int(e), h] == prompt.to_go[row, 0]) and (one.to_go[int(v), w] == window.to_go[row, 0])
            for one in (first, second)
            for e, h in [(prompt.observations[row, 0, 0], prompt.steps[row, 0])]
            for v, w in [(window.observations[row, 0, 0], window.steps[row, 0])]
            if max(e, v) < len(one.rewards)
        )


def test_prompts_are_left_out_at_random_and_where_there_is_no_other_episode() -> None:
    prompt, _ = drawn([histories(4)], dropout=0.25, count=800)
    assert (prompt.valid.all(axis=1) == prompt.valid.any(axis=1)).all()
    assert abs(prompt.valid[:, 0].mean() - 0.75) < 0.04
    alone, window = drawn([histories(1)])
    assert not alone.valid.any() and window.valid.any(axis=1).all()


def test_equal_generators_draw_equal_batches() -> None:
    one, two = (draw(np.random.default_rng(3), [histories(4)], Drawn(5, 2, W, P, 0.5), 1.0, 1.0) for _ in range(2))
    for a, b in zip((*one.prompt, *one.window), (*two.prompt, *two.window), strict=True):
        np.testing.assert_array_equal(a, b)
