"""Training batches: contexts of one variation, prefixes within them, labels of their own queries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icrl_dist.training.batches import Examples, Pool, TrainingBatch, draw
from icrl_dist.types import Identity, Task, Trajectory, Variation

HORIZON, QUERIES, ACTIONS = 5, 3, 4


def examples(variation: int, episodes: int, history: bool = False) -> Examples:
    """Each number encodes its origin: the state is 1000 v + 100 e + h in variation v, episode e and step h."""
    e, h = np.mgrid[:episodes, : HORIZON + 1]
    state = 1000 * variation + 100 * e + h
    query = 1000 * variation + np.arange(QUERIES)
    labels = np.zeros((QUERIES, ACTIONS), np.float32)
    labels[np.arange(QUERIES), (variation + np.arange(QUERIES)) % ACTIONS] = 1
    return Examples(
        observations=np.stack([state, -state], axis=-1).astype(np.float32),
        actions=(state[:, 1:] % 7).astype(np.int64),
        rewards=(state[:, 1:] % 11).astype(np.float32),
        queries=np.stack([query, -query], axis=-1).astype(np.float32),
        labels=labels,
        history=history,
    )


def check_row(batch: TrainingBatch, row: int) -> tuple[int, list[int], int]:
    """The (variation, episodes, length) of a row; checks the origin of every number in it."""
    state = batch.observations[row, :, 0].astype(int)
    length = int((batch.next_observations[row, :, 0] > 0).sum())
    assert length % HORIZON == 0
    assert length > 0
    for column in (batch.observations, batch.actions, batch.next_observations, batch.rewards):
        assert not column[row, length:].any(), "padding is not zero, or is not at the end"
    variations, episodes = set(), []
    for start in range(0, length, HORIZON):
        variations.add(state[start] // 1000)
        episode = state[start] % 1000 // 100
        episodes.append(int(episode))
        for h in range(HORIZON):
            here, there = batch.observations[row, start + h], batch.next_observations[row, start + h]
            assert int(here[0]) == state[start] + h
            assert int(here[0]) % 100 == h
            assert there[0] == here[0] + 1
            assert (there[1], here[1]) == (-there[0], -here[0])
            assert batch.actions[row, start + h] == there[0] % 7
            assert batch.rewards[row, start + h] == there[0] % 11
    assert len(variations) == 1, "a context mixes variations"
    variation = int(variations.pop())
    for n in range(batch.queries.shape[1]):
        q = int(batch.queries[row, n, 0])
        assert q // 1000 == variation, "a query belongs to another variation than its context"
        assert batch.queries[row, n, 1] == -q
        assert batch.labels[row, n].argmax() == (variation + q % 1000) % ACTIONS
        assert batch.labels[row, n].sum() == 1
    assert (batch.prefix[row] >= 0).all()
    assert (batch.prefix[row] <= length).all(), "a query sees padding"
    return variation, episodes, length


def drawn_batches(pools: list[Pool], count: int = 40, transitions: int = 0) -> list[TrainingBatch]:
    rng = np.random.default_rng(0)
    return [draw(rng, pools, 16, 6, transitions) for _ in range(count)]


def test_every_number_comes_from_one_variation_in_order() -> None:
    pool = Pool(1.0, [examples(1, 4), examples(2, 4), examples(3, 4)], 3)
    rows = [(b, *check_row(b, row)) for b in drawn_batches([pool]) for row in range(16)]
    assert {v for _, v, _, _ in rows} == {1, 2, 3}
    assert {len(e) for _, _, e, _ in rows} == {1, 2, 3}
    assert all(len(set(e)) == len(e) for _, _, e, _ in rows), "a context contains an episode twice"
    assert {e[0] for _, _, e, _ in rows} == {0, 1, 2, 3}
    assert any(e != sorted(e) for _, _, e, _ in rows)


def test_prefixes_are_uniform_from_empty_to_the_whole_context() -> None:
    pool = Pool(1.0, [examples(1, 2)], 1)
    for b in (all_batches := drawn_batches([pool])):
        assert b.observations.shape == (16, HORIZON, 2)
    counts = np.bincount(np.concatenate([b.prefix.ravel() for b in all_batches]))
    assert len(counts) == HORIZON + 1
    expected = 40 * 16 * 6 / (HORIZON + 1)
    assert np.abs(counts - expected).max() < 4.5 * np.sqrt(expected)


def test_history_contexts_are_the_first_episodes_in_order() -> None:
    pool = Pool(1.0, [examples(1, 3, history=True), examples(2, 3, history=True)], 3)
    seen = {tuple(check_row(b, row)[1]) for b in drawn_batches([pool]) for row in range(16)}
    assert seen == {(0,), (0, 1), (0, 1, 2)}


def test_a_variation_with_fewer_episodes_is_padded_at_the_end() -> None:
    pool = Pool(1.0, [examples(1, 1), examples(2, 3)], 3)
    lengths = {(b.actions.shape[1], *check_row(b, row)[::2]) for b in drawn_batches([pool]) for row in range(16)}
    assert (3 * HORIZON, 1, HORIZON) in lengths
    assert (3 * HORIZON, 2, 3 * HORIZON) in lengths
    # Never longer than its longest row.
    assert all(max(check_row(b, row)[2] for row in range(16)) == b.actions.shape[1] for b in drawn_batches([pool]))


def test_all_queries_are_drawn() -> None:
    drawn = np.concatenate([b.queries[..., 0].ravel() for b in drawn_batches([Pool(1.0, [examples(1, 2)], 3)])])
    assert set(drawn.astype(int)) == {1000, 1001, 1002}


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_pools_are_drawn_by_their_share(share: float) -> None:
    """A batch comes from one pool, and its contexts have at most that pool's number of episodes."""
    pools = [Pool(2 * share, [examples(1, 4)], 1), Pool(2 * (1 - share), [examples(2, 4), examples(3, 4)], 4)]
    drawn = [[check_row(b, row) for row in range(16)] for b in drawn_batches(pools, 200)]
    kinds = [{variation for variation, _, _ in rows} for rows in drawn]
    assert all(kind == {1} or kind <= {2, 3} for kind in kinds)
    assert abs(np.mean([kind == {1} for kind in kinds]) - share) <= 4.5 * np.sqrt(share * (1 - share) / len(kinds))
    assert (share == 1) or {2, 3} <= set.union(*kinds)
    lengths = {(variation == 1, len(episodes)) for rows in drawn for variation, episodes, _ in rows}
    possible = [(share > 0, {(True, 1)}), (share < 1, {(False, n) for n in range(1, 5)})]
    assert lengths == set().union(*(those for drawn, those in possible if drawn))


def test_a_batch_has_fewer_contexts_if_they_are_longer() -> None:
    pool = Pool(1.0, [examples(1, 4), examples(2, 4)], 4)
    sizes = {(len({*check_row(b, 0)[1]}), len(b.actions)) for b in drawn_batches([pool], transitions=6 * HORIZON)}
    assert sizes == {(1, 6), (2, 3), (3, 2), (4, 1)}
    assert {len(b.actions) for b in drawn_batches([pool], transitions=1)} == {1}, "one context of any length"
    short = Pool(1.0, [examples(1, 1), examples(2, 1)], 4)
    assert {len(b.actions) for b in drawn_batches([short], transitions=6 * HORIZON)} == {6}, (
        "transitions are not counted as drawn"
    )


def test_a_batch_repeats_with_its_generator() -> None:
    pool = [Pool(1.0, [examples(1, 4), examples(2, 4)], 3)]
    one, same, other = (draw(np.random.default_rng(seed), pool, 8, 4) for seed in (0, 0, 1))
    fields = [*TrainingBatch.__dataclass_fields__]
    assert all(np.array_equal(getattr(one, f), getattr(same, f)) for f in fields)
    assert not all(np.array_equal(getattr(one, f), getattr(other, f)) for f in fields)


def trajectory(trial: int) -> Trajectory:
    made: dict[str, Any] = {"observations": np.full((HORIZON + 1, 2), trial, np.float32)}
    made["actions"] = np.full(HORIZON, trial, np.int16)
    made["rewards"] = np.full(HORIZON, trial, np.float32)
    made["adversary"] = np.full(HORIZON, -1, np.int16)
    made["queries"], made["labels"] = np.zeros((0, 2), np.float32), np.zeros((0, ACTIONS), np.float32)
    made["prev_actions"], made["prev_rewards"] = np.zeros(0, np.int16), np.zeros(0, np.float32)
    identity = Identity("adapt", 0, 0, 0, trial)
    return Trajectory(identity, Variation(Task.of("darkroom")), -1, "", "test", origin="none", **made)


def test_examples_keep_the_episodes_order() -> None:
    made = Examples.of([trajectory(n) for n in (2, 0, 1)], np.ones((2, 2), np.float32), np.ones((2, ACTIONS), np.float32), True)
    assert made.actions[:, 0].tolist() == made.rewards[:, 0].tolist() == made.observations[:, 0, 0].tolist() == [2, 0, 1]
    assert made.actions.dtype == np.int64 and made.history is True


def test_examples_need_an_episode_and_a_label() -> None:
    labels = np.ones((2, ACTIONS), np.float32)
    with pytest.raises(ValueError, match="got 0 and 2"):
        Examples.of([], np.ones((2, 2), np.float32), labels)
    with pytest.raises(ValueError, match="got 1 and 0"):
        Examples.of([trajectory(0)], np.ones((0, 2), np.float32), labels[:0])
