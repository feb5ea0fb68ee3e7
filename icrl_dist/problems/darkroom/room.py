"""The environment Dark Room (appendix C.1): a hidden goal in a square room, reward 1 for every step on it.

A batch of variations is stepped together in numpy.  Each row draws from its own generator, so a
row's episode does not depend on the other rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from icrl_dist.arrays import short
from icrl_dist.copies import CopiedWhole
from icrl_dist.problems.checks import check_generators, check_parameters
from icrl_dist.problems.darkroom.adversaries import DIRECTIONS, disturbed_moves, is_override, override_distribution
from icrl_dist.types import Adversary, Spec, Step, Task, Variation

MOVES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0]])
"""The five actions: +x, -x, +y, -y, stay."""
ACTIONS = len(MOVES)


def task(goal: Sequence[int], size: int = 10, horizon: int = 100, start: Sequence[int] | None = None) -> Task:
    """The task with this goal cell; ``start=None`` draws a start cell uniformly each episode.

    Raises ValueError if goal or start lies outside the room.
    """
    made = Task.of("darkroom", goal=tuple(goal), size=size, horizon=horizon)
    made = made if start is None else made.replace(start=tuple(start))
    check(made)
    return made


def check(task: Task) -> None:
    """Raises ValueError, naming the parameter and its value, unless the task describes a room."""
    check_parameters(task, ("goal", "size", "horizon"), ("start",))
    size, horizon = task.number("size"), task.number("horizon")
    if not (size >= 2 and float(size).is_integer()):
        raise ValueError(f"darkroom size={size}: expected a whole number of cells, at least 2")
    if not (horizon >= 1 and float(horizon).is_integer()):
        raise ValueError(f"darkroom horizon={horizon}: expected a whole number of steps, at least 1")
    for name in ("goal", "start"):
        if name == "start" and task.get("start", "random") == "random":
            continue
        cell = task.vector(name)
        if len(cell) != 2 or any(c != int(c) or not 0 <= c < size for c in cell):
            raise ValueError(f"darkroom {name}={cell} lies outside the {size:g}x{size:g} room: use 0..{size - 1:g}")


def spec(task: Task) -> Spec:
    """Spec of the room: two coordinates, five actions."""
    size = task.number("size")
    return Spec(low=(0.0, 0.0), high=(size - 1.0, size - 1.0), actions=ACTIONS, horizon=int(task.number("horizon")))


def cells(size: int) -> Float[np.ndarray, "C 2"]:
    """All C = size^2 cells as ``(x, y)``; the number of a cell is x * size + y."""
    x, y = np.divmod(np.arange(size * size), size)
    return np.stack([x, y], axis=1).astype(np.float32)


def next_cell(size: int) -> Int[np.ndarray, "C A"]:
    """Number of the cell that each action leads to from each cell; a move into a wall changes nothing."""
    moved = np.clip(cells(size).astype(np.int64)[:, None, :] + MOVES[None], 0, size - 1)
    table: np.ndarray = moved[..., 0] * size + moved[..., 1]
    return table


def next_move(size: int) -> Int[np.ndarray, "C X"]:
    """Number of the cell that each move leads to from each cell.

    Move a, below ``ACTIONS``, is action a alone.  Move ``ACTIONS + 4 * a + d`` is action a and then a wind in direction
    d, a displacement as by action d.  Walls stop each of the two.
    """
    alone = next_cell(size)
    return np.concatenate([alone, alone[alone][:, :, :DIRECTIONS].reshape(len(alone), -1)], axis=1)


class DarkRoom(CopiedWhole):
    """B variation environments of one size and horizon, stepped as one batch."""

    def __init__(self, variations: Sequence[Variation]) -> None:
        tasks = [v.task for v in variations]
        for one in tasks:
            check(one)
        shapes = {(t.number("size"), t.number("horizon")) for t in tasks}
        if len(shapes) != 1:
            raise ValueError(f"darkroom: one batch holds one size and horizon, not {sorted(shapes)}")
        size = int(tasks[0].number("size"))
        self.spec = spec(tasks[0])
        self.batch = len(tasks)
        self._h = self.spec.horizon
        self._cells = cells(size)
        self._next = next_move(size).ravel()
        self._moves = ACTIONS * (1 + DIRECTIONS)
        self._goal = np.array([int(g[0]) * size + int(g[1]) for g in (t.vector("goal") for t in tasks)])
        starts = [t.get("start", "random") for t in tasks]
        self._start = np.array([-1 if isinstance(s, (str, int, float)) else int(s[0]) * size + int(s[1]) for s in starts])
        adversaries = [v.adversary for v in variations]
        each = {a: _disturbance(a) for a in set(adversaries)}
        self._p = np.array([each[a][0] for a in adversaries])
        self._edges = np.stack([each[a][1] for a in adversaries])
        self._disturbed = np.stack([each[a][2] for a in adversaries])
        self._override = np.array([is_override(a) for a in adversaries])

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float[np.ndarray, "B S"]:
        """Start an episode in every row; all random numbers of the episode are drawn here, row by row."""
        check_generators("darkroom", self.batch, rngs)
        u = np.stack([rng.random(1 + self.spec.horizon) for rng in rngs], axis=1)
        random_start = (u[0] * len(self._cells)).astype(np.int64)
        self._noise: Float64[np.ndarray, "H B"] = u[1:]
        self._cell = np.where(self._start >= 0, self._start, random_start)
        self._h = 0
        observation: np.ndarray = self._cells[self._cell]
        return observation

    def step(self, actions: Int[np.ndarray, " B"]) -> Step:
        """Execute one action in every row.  Raises RuntimeError past the horizon or before a reset."""
        if self._h >= self.spec.horizon:
            raise RuntimeError(f"darkroom: stepped past the horizon of {self.spec.horizon}; call reset first")
        right = actions.shape == (self.batch,) and actions.dtype.kind in "iu"
        if not right or actions.min() < 0 or actions.max() >= ACTIONS:
            raise ValueError(f"darkroom: actions {short(actions)}: expected {self.batch} numbers in 0..{ACTIONS - 1}")
        u = self._noise[self._h]
        drawn = np.zeros(self.batch, dtype=np.int64)
        for edge in self._edges.T:
            drawn += u >= edge
        reported = drawn
        if not self._override.all():
            drawn = np.where(self._override, drawn, self._disturbed[np.arange(self.batch), actions])
            reported = np.where(drawn < ACTIONS, drawn, (drawn - ACTIONS) % DIRECTIONS)
        disturbed = u < self._p
        executed = np.where(disturbed, drawn, actions)
        self._cell = self._next[self._cell * self._moves + executed]
        self._h += 1
        return Step(
            observation=self._cells[self._cell],
            reward=(self._cell == self._goal).astype(np.float32),
            done=self._h == self.spec.horizon,
            adversary=np.where(disturbed, reported, -1).astype(np.int16),
        )

    def image(self, row: int) -> UInt8[np.ndarray, "height width 3"]:
        """The room from above, x to the right and y upwards: goal green, agent blue; 24 pixels per cell."""
        size = round(len(self._cells) ** 0.5)
        room = np.full((size, size, 3), 235, np.uint8)
        for cell, color in ((self._goal[row], (45, 164, 78)), (self._cell[row], (31, 111, 235))):
            x, y = divmod(int(cell), size)
            room[size - 1 - y, x] = color
        return room.repeat(24, axis=0).repeat(24, axis=1)


def _disturbance(adversary: Adversary) -> tuple[float, Float64[np.ndarray, " E"], Int[np.ndarray, " A"]]:
    """p, the edges and the moves of an adversary.

    One uniform number u decides a step: if u < p the adversary acts.  The number of edges at most u is the action that
    an override executes; another disturbance makes the move that belongs to the agent's action.
    """
    if is_override(adversary):
        p, q = override_distribution(adversary, ACTIONS)
        return p, p * np.cumsum(q)[:-1], np.zeros(ACTIONS, np.int64)
    p, moves = disturbed_moves(adversary, ACTIONS)
    return p, np.ones(ACTIONS - 1), moves
