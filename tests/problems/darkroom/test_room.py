"""Dark Room against a slow environment of Python ints, and the frequencies of its adversary."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom.adversaries import argmax_distribution
from icrl_dist.problems.darkroom.room import ACTIONS, DarkRoom
from icrl_dist.types import NULL, Adversary, Step, Task, Variation

Room = Callable[[int, int], tuple[Task, ...]]
ALPHA = (0.1, 1.0, 0.5, 2.0, 0.3)
MEDDLER = Adversary.of("dirichlet", p=0.3, alpha=ALPHA)


def rngs(seeds: Sequence[int]) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds]


def slow_step(cell: tuple[int, int], executed: int, size: int) -> tuple[int, int]:
    """A second implementation of the room for one environment, by the appendix."""
    x, y = cell
    if executed == 0 and x < size - 1:
        return x + 1, y
    if executed == 1 and x > 0:
        return x - 1, y
    if executed == 2 and y < size - 1:
        return x, y + 1
    if executed == 3 and y > 0:
        return x, y - 1
    return x, y


def play(room: DarkRoom, seeds: Sequence[int], actions: np.ndarray) -> tuple[np.ndarray, list[Step]]:
    start = room.reset(rngs(seeds))
    return start, [room.step(a) for a in actions]


@pytest.mark.parametrize("size", range(2, 8))
@pytest.mark.parametrize("adversary", [NULL, MEDDLER, Adversary.of("uniform", p=1.0)], ids=lambda a: a.kind)
def test_every_step_equals_the_slow_loop(room: Room, size: int, adversary: Adversary) -> None:
    horizon = 8 * size
    tasks = room(size, horizon)
    actions = np.random.default_rng(size).integers(0, ACTIONS, size=(horizon, len(tasks)))
    start, steps = play(DarkRoom([Variation(t, adversary) for t in tasks]), range(len(tasks)), actions)
    visited, used, rewarded = set(), set(), 0
    for row, task in enumerate(tasks):
        cell = (int(start[row][0]), int(start[row][1]))
        assert all(0 <= c < size for c in cell)
        for h, step in enumerate(steps):
            override = int(step.adversary[row])
            executed = override if override >= 0 else int(actions[h, row])
            cell = slow_step(cell, executed, size)
            assert tuple(step.observation[row]) == cell
            assert step.reward[row] == (1.0 if cell == task["goal"] else 0.0)
            visited.add(cell)
            used.add(executed)
            rewarded += cell == task["goal"]
    assert len(visited) == size * size, "a cell was never reached, so the comparison proves too little"
    assert used == set(range(ACTIONS))
    assert rewarded > 0


def test_adversary_takes_over_with_p_and_draws_from_q() -> None:
    """P(executed = b | a) = (1 - p) [a = b] + p q_b, measured by the agent's moves."""
    # The room is so large that 100 steps from its center never reach a wall, so every move is visible.
    size, horizon, rows, p = 203, 100, 60, 0.3
    variation = Variation(darkroom.task((0, 0), size, horizon, start=(101, 101)), MEDDLER)
    direction = {move: b for b, move in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1), (0, 0)])}
    q, n = argmax_distribution(ALPHA), horizon * rows
    for a in range(ACTIONS):
        start, steps = play(
            DarkRoom([variation] * rows), range(a * rows, (a + 1) * rows), np.full((horizon, rows), a, np.int64)
        )
        path = np.stack([start, *(s.observation for s in steps)])
        moves = (path[1:] - path[:-1]).reshape(n, 2)
        executed = np.array([direction[int(x), int(y)] for x, y in moves])
        logged = np.concatenate([s.adversary for s in steps])
        np.testing.assert_array_equal(executed, np.where(logged >= 0, logged, a))
        for b in range(ACTIONS):
            expected = (1 - p) * (a == b) + p * q[b]
            error = 4 * np.sqrt(expected * (1 - expected) / n)
            assert abs((executed == b).mean() - expected) < error, (a, b)
            # An override by the agent's own action is still an override.
            override = p * q[b]
            assert abs((logged == b).mean() - override) < 4 * np.sqrt(override * (1 - override) / n), (a, b)


@pytest.mark.parametrize(("p", "share"), [(0.0, 0.0), (1.0, 1.0)])
def test_p_of_0_and_1(p: float, share: float) -> None:
    variation = Variation(darkroom.task((0, 0), 3, 30), Adversary.of("uniform", p=p))
    _, steps = play(DarkRoom([variation] * 20), range(20), np.zeros((30, 20), np.int64))
    assert np.mean([s.adversary >= 0 for s in steps]) == share


def test_walls_stop_and_reward_comes_on_every_step_on_the_goal() -> None:
    corner = darkroom.task((0, 0), 4, 7, start=(1, 0))
    room = DarkRoom([Variation(corner)])
    # stay off the goal, step on it, run into both walls on it, stay, leave, come back
    actions = [4, 1, 1, 3, 4, 2, 3]
    start, steps = play(room, [0], np.array(actions)[:, None])
    assert tuple(start[0]) == (1, 0)
    assert [tuple(s.observation[0]) for s in steps] == [(1, 0), (0, 0), (0, 0), (0, 0), (0, 0), (0, 1), (0, 0)]
    assert [float(s.reward[0]) for s in steps] == [0, 1, 1, 1, 1, 0, 1]


def test_random_starts_are_uniform_and_a_given_start_is_kept() -> None:
    random = Variation(darkroom.task((0, 0), 3, 1))
    fixed = Variation(darkroom.task((0, 0), 3, 1, start=(2, 1)))
    room = DarkRoom([random] * 1800 + [fixed] * 10)
    start = room.reset(rngs(range(1810)))
    counts = np.unique(start[:1800] @ [3, 1], return_counts=True)[1]
    assert len(counts) == 9
    assert np.abs(counts - 200).max() < 4 * np.sqrt(1800 * (1 / 9) * (8 / 9))
    assert (start[1800:] == [2, 1]).all()


def test_a_row_does_not_depend_on_the_other_rows(room: Room) -> None:
    horizon, tasks = 25, room(5, 25)
    adversaries = (NULL, MEDDLER, Adversary.of("uniform", p=0.5))
    variations = [Variation(tasks[row % 25], adversaries[row % 3]) for row in range(50)]
    actions = np.random.default_rng(0).integers(0, ACTIONS, size=(horizon, 50))

    def bytes_of(start: np.ndarray, steps: list[Step], row: int) -> bytes:
        arrays = [start[row], *(a for s in steps for a in (s.observation[row], s.reward[row], s.adversary[row]))]
        return b"".join(np.asarray(a).tobytes() for a in arrays)

    together = play(DarkRoom(variations), range(50), actions)
    for row in range(50):
        single = play(DarkRoom([variations[row]]), [row], actions[:, row : row + 1])
        assert bytes_of(*single, 0) == bytes_of(*together, row)


def test_actions_of_the_agent_do_not_change_those_of_the_adversary() -> None:
    """All draws happen at reset: when and how the adversary acts does not depend on the agent's actions."""
    variation = Variation(darkroom.task((0, 0), 5, 40), MEDDLER)
    first, other = (
        np.stack([s.adversary for s in play(DarkRoom([variation] * 4), range(4), np.full((40, 4), a, np.int64))[1]])
        for a in (0, 4)
    )
    np.testing.assert_array_equal(first, other)
    assert (first >= 0).any()


def test_horizon_is_enforced() -> None:
    room = DarkRoom([Variation(darkroom.task((0, 0), 3, 4))] * 2)
    stay = np.full(2, 4)
    with pytest.raises(RuntimeError, match="reset"):
        room.step(stay)
    for _ in range(2):
        _, steps = play(room, [0, 1], np.full((4, 2), 4))
        assert [s.done for s in steps] == [False, False, False, True]
        with pytest.raises(RuntimeError, match="horizon of 4"):
            room.step(stay)


@pytest.mark.parametrize("actions", [[0, 5], [-1, 0], [0], [0, 0, 0]])
def test_invalid_actions_are_refused(actions: list[int]) -> None:
    room = DarkRoom([Variation(darkroom.task((0, 0), 3, 4))] * 2)
    room.reset(rngs([0, 1]))
    with pytest.raises(ValueError, match="action"):
        room.step(np.array(actions))


def test_a_wrong_number_of_generators_is_refused() -> None:
    with pytest.raises(ValueError, match="3 generators for 1 rows"):
        DarkRoom([Variation(darkroom.task((0, 0), 3, 4))]).reset(rngs([0, 1, 2]))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"goal": (3, 0)}, r"goal=\(3, 0\).*3x3.*0\.\.2"),
        ({"goal": (0, -1)}, r"goal=\(0, -1\)"),
        ({"goal": (0.5, 1)}, r"goal=\(0\.5, 1\)"),
        ({"goal": (1, 1, 1)}, r"goal=\(1, 1, 1\)"),
        ({"start": (0, 7)}, r"start=\(0, 7\)"),
        ({"size": 2.5}, r"size=2\.5"),
        ({"size": 1}, r"size=1\b"),
        ({"size": float("nan")}, r"size=nan"),
        ({"horizon": 0}, r"horizon=0"),
        ({"horizon": 1.5}, r"horizon=1\.5"),
        ({"horizon": float("inf")}, r"horizon=inf"),
    ],
)
def test_an_impossible_room_is_refused_with_its_value(wrong: dict[str, object], message: str) -> None:
    task = darkroom.task((1, 1), 3, 5).replace(**wrong)
    with pytest.raises(ValueError, match=message):
        DarkRoom([Variation(task)])


def test_task_itself_refuses_a_goal_outside() -> None:
    with pytest.raises(ValueError, match=r"goal=\(9, 9\)"):
        darkroom.task((9, 9), 3, 5)
    with pytest.raises(ValueError, match=r"start=\(3, 0\)"):
        darkroom.task((0, 0), 3, 5, start=(3, 0))


@pytest.mark.parametrize(
    ("adversary", "message"),
    [
        (Adversary.of("uniform", p=1.2), r"p=1\.2"),
        (Adversary.of("dirichlet", p=-0.1, alpha=ALPHA), r"p=-0\.1"),
        (Adversary.of("uniform", p=float("nan")), "p=nan"),
        (Adversary.of("dirichlet", p=0.1, alpha=[1.0, 1.0]), r"alpha=\(1\.0, 1\.0\).*5 numbers"),
        (Adversary.of("dirichlet", p=0.1, alpha=[1.0, 1.0, 0.0, 1.0, 1.0]), "above 0"),
        (Adversary.of("gust", p=0.1), "'gust'.*null, uniform, dirichlet, wind, permuted"),
        (Adversary.of("wind", p=0.1), "'direction' is missing"),
        (Adversary.of("wind", p=1.5, direction=0), r"p=1\.5.*\[0, 1\]"),
        (Adversary.of("wind", p=0.1, direction=4), "direction=4: expected 0, 1, 2 or 3"),
        (Adversary.of("wind", p=0.1, direction=-1), "direction=-1"),
        (Adversary.of("wind", p=0.1, direction=1.5), r"direction=1\.5"),
        (Adversary.of("permuted", p=-0.1, permutation=(0, 1, 2, 3, 4)), r"p=-0\.1.*\[0, 1\]"),
        (Adversary.of("permuted", p=0.1, permutation=(0, 1, 2, 3)), r"\(0, 1, 2, 3\): expected each of 0 to 4 once"),
        (Adversary.of("permuted", p=0.1, permutation=(0, 1, 2, 3, 3)), "3, 3.*each of 0 to 4 once"),
        (Adversary.of("permuted", p=0.1, permutation=(1, 2, 3, 4, 5)), "each of 0 to 4 once"),
        (Adversary.of("permuted", p=0.1, permutation=(0.5, 1, 2, 3, 4)), r"0\.5.*each of 0 to 4 once"),
    ],
)
def test_an_impossible_adversary_is_refused_with_its_value(adversary: Adversary, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DarkRoom([Variation(darkroom.task((0, 0), 3, 5), adversary)])


def test_mixed_batches_are_refused() -> None:
    small = Variation(darkroom.task((0, 0), 3, 5))
    with pytest.raises(ValueError, match=r"\(3, 5\), \(4, 5\)"):
        DarkRoom([small, Variation(darkroom.task((0, 0), 4, 5))])
    with pytest.raises(ValueError, match=r"\(3, 5\), \(3, 6\)"):
        DarkRoom([small, Variation(darkroom.task((0, 0), 3, 6))])


def test_step_has_the_dtypes_of_messages_and_does_not_share_memory(room: Room) -> None:
    batch = DarkRoom([Variation(t, MEDDLER) for t in room(3, 5)])
    start = batch.reset(rngs(range(9)))
    kept = start.copy()
    step = batch.step(np.arange(9) % 5)
    assert step.observation.dtype == step.reward.dtype == np.float32 and step.adversary.dtype == np.int16
    step.observation[:] = -1
    np.testing.assert_array_equal(start, kept)
    assert (batch.step(np.full(9, 4)).observation >= 0).all(), "writing into a returned array changed the room"
