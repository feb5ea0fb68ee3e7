"""The behavior policies of pretraining contexts, against their descriptions."""

import numpy as np
import pytest

from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.darkroom.behavior_policies import KEEP, Walks, towards
from icrl_dist.problems.darkroom.room import MOVES
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Variation

SIZE, HORIZON = 6, 80


def walk(kind, rows=40, seed=0, size=SIZE, horizon=HORIZON):
    env = registry.batch([Variation(room.task((0, 0), size, horizon))] * rows)
    rngs = [np.random.default_rng([seed, row]) for row in range(rows)]
    return episode(env, Walks(size, horizon, [kind] * rows, rngs), rngs)


def visited(ran, row, upto=None):
    return {tuple(cell) for cell in ran.observations[row, :upto].astype(int).tolist()}


@pytest.mark.parametrize("seed", range(5))
def test_towards_moves_closer_and_stays_at_the_target(seed):
    rng = np.random.default_rng(seed)
    here, target = rng.integers(0, SIZE, (2, 50, 2)).astype(float)
    target[:5] = here[:5]
    for at, to, probabilities in zip(here, target, towards(here, target), strict=True):
        assert probabilities.sum() == pytest.approx(1)
        for move, p in zip(MOVES, probabilities, strict=True):
            gain = np.abs(to - at).sum() - np.abs(to - at - move).sum()
            if (to == at).all():
                assert p == (not move.any())
            else:
                assert (p > 0) == (gain > 0)
                assert p == 0 or p == pytest.approx(abs((to - at) @ np.abs(move)) / np.abs(to - at).sum())


def test_persistent_walks_mostly_repeat_their_action():
    again = (np.diff(walk("persistent", 200).actions, axis=1) == 0).mean()
    expected = np.mean(KEEP) + (1 - np.mean(KEEP)) / 5
    assert abs(again - expected) < 0.02
    assert abs((np.diff(walk("random", 200).actions, axis=1) == 0).mean() - 0.2) < 0.02


def test_a_sweep_enters_new_cells_until_none_is_left():
    ran = walk("sweep")
    assert np.mean([len(visited(ran, row)) for row in range(40)]) > 0.95 * SIZE**2
    assert np.mean([len(visited(ran, row, 19)) for row in range(40)]) > 15
    assert np.mean([len(visited(walk("random"), row)) for row in range(40)]) < 0.6 * SIZE**2


def test_walks_to_goals_stay_for_a_while_where_they_arrive():
    ran = walk("goals")
    stay = (ran.actions == len(MOVES) - 1).mean()
    assert 0.1 < stay < 0.4
    assert len({tuple(ran.observations[row, -1]) for row in range(40)}) > 15, "rows share their targets"


def test_rows_are_independent_and_have_their_own_draws():
    kinds = ["sweep", "goals", "persistent", "random"] * 2
    task = Variation(room.task((2, 2), SIZE, HORIZON))
    together = [np.random.default_rng([7, row]) for row in range(8)]
    ran = episode(registry.batch([task] * 8), Walks(SIZE, HORIZON, kinds, together), together)
    for row, kind in enumerate(kinds):
        own = [np.random.default_rng([7, row])]
        single = episode(registry.batch([task]), Walks(SIZE, HORIZON, [kind], own), own)
        np.testing.assert_array_equal(single.observations[0], ran.observations[row])
