"""The game of ``icrl-dist play``: a Dark Room in which a person acts as the adversary of a live agent.

The person moves the goal and overrides actions, one by one or at random.  The agent observes
neither, and its weights never change.
"""

from __future__ import annotations

import functools
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.problems.darkroom.posterior import Belief, RoomPosterior
from icrl_dist.problems.darkroom.room import ACTIONS, cells, next_cell
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns
from icrl_dist.types import NULL, Adversary

if TYPE_CHECKING:
    from icrl_dist.agent.in_context_agent import InContextAgent

EPISODES = 400
"""Number of finished episodes that are kept and shown."""
SPEEDS = (0.5, 100.0)
"""Minimum and maximum speed, steps per second."""
HELD_S = 1.5
"""A held override ends after this time unless ``hold`` is called again, because its viewer may have disconnected."""
_SUPPOSED = (NULL, Adversary.of("uniform", p=0.4))
"""Adversaries assumed in the posteriors over the goal; the exact posterior does not depend on them."""

Cause = Literal["agent", "random", "person"]
"""Who selected an executed action: the agent, a random override, or the person."""


class Played(NamedTuple):
    """One finished episode."""

    total: float
    optimum: float | None
    """Expected return of the optimal policy given goal and overrides; None if either changed during the episode."""
    overridden: int
    by_hand: int
    """Number of the overrides by the person."""


class PlayGame:
    """One agent in one room; the caller calls ``step``.  Every episode starts in the origin, as in evaluation.

    Not thread-safe.  The same agent, seed and commands between the same steps give the same episodes.
    """

    def __init__(self, agent: InContextAgent, run: Run, seed: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        """``run``: the run that trained the agent.  ``clock``: time in seconds, by which a held override ends."""
        room: DarkRoomConfig = run.section("darkroom")
        goals = agent.manifest.get("test_goals") or [[room.size - 1] * 2]
        self.agent, self.size, self.horizon = agent, room.size, room.horizon
        self.goal, self.p, self.override_probs = int(goals[0][0]) * room.size + int(goals[0][1]), 0.0, _UNIFORM
        self.speed, self.paused, self.keep = 8.0, False, False
        self._rng, self._clock = np.random.default_rng(seed), clock
        self._next, self._cells = next_cell(room.size), cells(room.size)
        self._beliefs = RoomPosterior(room.size, room.horizon, _SUPPOSED, room.gamma, room.label_slack)
        self.context_max = run.context.max
        self._once: int | None = None
        self._held: int | None = None
        self._held_until = 0.0
        self._steps_due = 0
        self.restart()

    def restart(self) -> None:
        """Restart: the same weights, an empty context, the first episode."""
        self._clear_context()
        self.episodes: deque[Played] = deque(maxlen=EPISODES)
        self.number = 1
        self._start_episode()

    def _clear_context(self) -> None:
        self.agent.reset_context()
        self._since_move = self._not_in_context = 0

    def _start_episode(self) -> None:
        self.cell, self.steps, self.total, self._changed = 0, 0, 0.0, False
        self.path: list[tuple[int, Cause]] = []

    @property
    def optimum(self) -> float:
        """Expected return of the optimal policy given goal and overrides: exact, by value iteration."""
        return _optimum(self.size, self.horizon, self.goal, self.p, self.override_probs)

    @property
    def wait_s(self) -> float | None:
        """Time between two steps; None while paused."""
        return 0.0 if self._steps_due else None if self.paused else 1.0 / self.speed

    def step(self) -> None:
        """One step: the agent selects an action, an override may replace it, and the agent observes its own action and
        the outcome."""
        if self.steps == self.horizon:
            self.number += 1
            self._start_episode()
        self._steps_due = max(0, self._steps_due - 1)
        before = self._cells[self.cell]
        (action,) = self.agent.act([before])
        executed, cause = self._executed(int(action))
        self.cell = int(self._next[self.cell, executed])
        self.steps += 1
        reward, done = float(self.cell == self.goal), self.steps == self.horizon
        self.agent.observe([before], [action], [reward], [self._cells[self.cell]], [done])
        self.total += reward
        self._since_move += 1
        self._not_in_context = 0 if done or self.agent.deploy != "paper" else self._not_in_context + 1
        self.path.append((self.cell, cause))
        if done:
            causes = [c for _, c in self.path]
            optimum = None if self._changed else self.optimum
            self.episodes.append(Played(self.total, optimum, self.horizon - causes.count("agent"), causes.count("person")))

    def _executed(self, action: int) -> tuple[int, Cause]:
        u, drawn = self._rng.random(), int(self._rng.choice(ACTIONS, p=self.override_probs))
        chosen, self._once = self._once, None
        if chosen is None and self._clock() < self._held_until:
            chosen = self._held
        if chosen is not None:
            return chosen, "person"
        return (drawn, "random") if u < self.p else (action, "agent")

    def belief(self) -> Belief:
        """The posterior over goals that the agent's action distributions imply, and the exact posterior.

        The exact posterior uses only the transitions in the agent's context since the goal last moved.
        """
        return self._beliefs.read(self.agent, last=max(0, self._since_move - self._not_in_context))

    def command(self, fields: dict[str, Any]) -> None:
        """Execute a viewer's command.  Raises ValueError with the wrong value and the expected one."""
        do = fields.get("do")
        if not isinstance(do, str) or do not in COMMANDS:
            raise ValueError(f"do={str(do)[:40]!r}: expected one of {', '.join(COMMANDS)}")
        check, execute = COMMANDS[do]
        names = {"do", *([] if check is None else ["value"])}
        if fields.keys() != names:
            raise ValueError(f"{do}: expected the fields {', '.join(sorted(names))}")
        execute(self, *([] if check is None else [check(self, fields["value"])]))

    def move_goal(self, cell: int) -> None:
        """Move the goal, from the next step on.

        The new goal is another task, so the agent's context is cleared.  With ``keep`` the agent keeps its
        context, which describes the old goal; no goal moved within a context in training.
        """
        if cell == self.goal:
            return
        self.goal, self._since_move = cell, 0
        self._changed |= self.steps < self.horizon and self.steps > 0
        if not self.keep:
            self._clear_context()

    def keep_context(self, keep: bool) -> None:
        self.keep = keep

    def override(self, p: float) -> None:
        """Override each action with probability p from now on."""
        self._changed |= p != self.p and self.steps > 0
        self.p = p

    def choose_distribution(self, action: int | None) -> None:
        """Draw overriding actions from this action only, or uniformly from all actions if None."""
        probs = _UNIFORM if action is None else tuple(float(a == action) for a in range(ACTIONS))
        self._changed |= probs != self.override_probs and self.p > 0 and self.steps > 0
        self.override_probs = probs

    def override_once(self, action: int) -> None:
        """Execute this action in the next step instead of the agent's."""
        self._once = action

    def hold(self, action: int | None) -> None:
        """Execute this action in every step until ``hold(None)``, but for at most ``HELD_S``."""
        if action is None:
            self._held_until = 0.0
            return
        if action != self._held or self._clock() >= self._held_until:
            self._once = action
        self._held, self._held_until = action, self._clock() + HELD_S

    def pause(self, paused: bool) -> None:
        self.paused, self._steps_due = paused, 0

    def one_step(self) -> None:
        """Pause and make one step."""
        self.paused, self._steps_due = True, min(self._steps_due + 1, self.horizon)

    def one_episode(self) -> None:
        """Pause and run to the end of this episode, or of the next if it has ended, at full speed."""
        self.paused, self._steps_due = True, self.horizon - self.steps % self.horizon

    def change_speed(self, speed: float) -> None:
        self.speed = speed

    def snapshot(self) -> dict[str, Any]:
        """The state of the room as JSON values; a cell is the number x * size + y."""
        surprise = float(self.agent.surprise[0]) if self.agent.outcomes else None
        return {
            "size": self.size,
            "horizon": self.horizon,
            "goal": self.goal,
            "cell": self.cell,
            "episode": self.number,
            "step": self.steps,
            "total": self.total,
            "optimum": round(self.optimum, 2),
            "path": [[0, "start"], *([cell, cause] for cell, cause in self.path)],
            "p": self.p,
            "distribution": None if self.override_probs == _UNIFORM else self.override_probs.index(1.0),
            "held": self._held if self._clock() < self._held_until else None,
            "speed": self.speed,
            "paused": self.paused,
            "surprise": None if surprise is None or not np.isfinite(surprise) else round(surprise, 3),
            "keep": self.keep,
            "context_max": self.context_max,
            "deploy": self.agent.deploy,
        }

    def history(self) -> dict[str, Any]:
        """The kept finished episodes as JSON columns, and the number of the first one."""
        columns = zip(*self.episodes, strict=True) if self.episodes else ([] for _ in Played._fields)
        finished = self.number - (self.steps < self.horizon)
        first = finished - len(self.episodes) + 1
        return {"first": first, **{name: list(c) for name, c in zip(Played._fields, columns, strict=True)}}


_UNIFORM = (1.0 / ACTIONS,) * ACTIONS


@functools.lru_cache(maxsize=4096)
def _optimum(size: int, horizon: int, goal: int, p: float, override_probs: tuple[float, ...]) -> float:
    h = Hypotheses(size, horizon, np.array([goal]), np.array([p]), np.array([override_probs]))
    return float(optimal_returns(h)[0])


def _cell(game: PlayGame, value: object) -> int:
    if not (isinstance(value, list) and len(value) == 2 and all(type(c) is int and 0 <= c < game.size for c in value)):
        raise ValueError(f"goal={str(value)[:40]}: expected [x, y], each 0 to {game.size - 1}")
    return int(value[0] * game.size + value[1])


def _action(game: PlayGame, value: object) -> int:
    if type(value) is not int or not 0 <= value < ACTIONS:
        raise ValueError(f"action={str(value)[:40]}: expected 0 to {ACTIONS - 1} (+x, -x, +y, -y, stay)")
    return value


def _action_or_none(game: PlayGame, value: object) -> int | None:
    return None if value is None else _action(game, value)


def _number(low: float, high: float, what: str) -> Callable[[PlayGame, object], float]:
    def check(game: PlayGame, value: object) -> float:
        if type(value) not in (int, float) or not low <= value <= high:  # type: ignore[operator]
            raise ValueError(f"{what}={str(value)[:40]}: expected a number from {low:g} to {high:g}")
        return round(float(value), 3)  # type: ignore[arg-type]

    return check


def _flag(game: PlayGame, value: object) -> bool:
    if type(value) is not bool:
        raise ValueError(f"value={str(value)[:40]}: expected true or false")
    return value


COMMANDS: dict[str, tuple[Callable[[PlayGame, object], Any] | None, Callable[..., None]]] = {
    "goal": (_cell, PlayGame.move_goal),
    "p": (_number(0.0, 1.0, "p"), PlayGame.override),
    "distribution": (_action_or_none, PlayGame.choose_distribution),
    "push": (_action, PlayGame.override_once),
    "hold": (_action_or_none, PlayGame.hold),
    "speed": (_number(*SPEEDS, "speed"), PlayGame.change_speed),
    "pause": (_flag, PlayGame.pause),
    "keep": (_flag, PlayGame.keep_context),
    "step": (None, PlayGame.one_step),
    "episode": (None, PlayGame.one_episode),
    "new": (None, PlayGame.restart),
}
"""Commands of a viewer by name: the check of the value (None if there is no value), and the method to call."""
