"""Adaptation, variation by variation: returns over episodes, and some episodes to be drawn."""

from __future__ import annotations

import functools
from collections import OrderedDict, deque
from typing import Any

from icrl_dist.monitor import plain, sketch
from icrl_dist.monitor.plain import Odd
from icrl_dist.types import Identity

VARIATIONS = 4096
"""Variations that are kept; further ones are only counted."""
_EPISODES = 256
"""Returns kept of a phase, a variation: of longer phases the newest."""
_PHASES = 3
"""Phases kept of a variation, the newest."""
_LINEAGE = 32
_TOGETHER = 4096
"""Episodes of a variation that a message tells of, at most."""
_DRAWN = 48
"""Episodes kept to be drawn."""
_OPTIMA = 4
"""Optima computed a tick, at most: each takes some milliseconds."""
_TOLD = 200
"""Variations told of a tick, at most; the others follow in their turn."""


class Curve:
    """One variation: who and where it is, and what was earned in it."""

    __slots__ = ("adversary", "changed", "dirty", "lineage", "optimum", "phases", "problem", "quarantine", "task")

    def __init__(self, message: dict[str, Any]) -> None:
        self.describe(message)
        self.phases: OrderedDict[str, dict[int, float]] = OrderedDict()
        self.lineage: deque[tuple[str, int, float, int, str, str, float]] = deque(maxlen=_LINEAGE)
        self.optimum: float | None = None
        self.quarantine = ""
        self.changed = 0
        self.dirty = False

    def describe(self, message: dict[str, Any]) -> None:
        """What it is in the phase that begins."""
        self.problem = plain.text(message.get("problem"), 64)
        self.task = plain.named(message.get("task"))
        self.adversary = plain.named(message.get("adversary"))


class Curves:
    """A bounded table of variations, named ``TASK/VARIATION``."""

    def __init__(self) -> None:
        self._curves: dict[tuple[int, int], Curve] = {}
        self._left_out: set[tuple[int, int]] = set()
        self._unsolved: deque[Curve] = deque()
        self._dirty: deque[Curve] = deque()
        self._episodes: OrderedDict[tuple[int, int], dict[str, Any]] = OrderedDict()
        self._next = 1

    def __len__(self) -> int:
        """Variations that were heard of."""
        return len(self._curves) + len(self._left_out)

    def returned(self, told: dict[str, Any], worker: str, time: float) -> int:
        """Episodes of a variation ended: as in an entry of ``variations`` in docs/tap.md; how many."""
        identity = _of_variation(plain.text(told.get("identity"), 120))
        trials, returns = (plain.listed(told.get(name), _TOGETHER) for name in ("trials", "returns"))
        if len(trials) != len(returns):
            raise Odd("schema")
        place = identity.task, identity.variation
        curve = self._curves.get(place)
        if curve is None:
            if len(self._curves) >= VARIATIONS:
                if len(self._left_out) < 16 * VARIATIONS:
                    self._left_out.add(place)
                raise Odd("too many variations")
            curve = self._curves[place] = Curve(told)
        weights, digest = plain.integer(told.get("weights"), -1), plain.text(told.get("digest"), 64)
        name = f"{identity.stage}/{identity.round}"
        known = curve.phases.get(name)
        if known is None:
            curve.describe(told)
            self._unsolved.append(curve)
            known = curve.phases[name] = {}
            if len(curve.phases) > _PHASES:
                curve.phases.popitem(last=False)
        for trial, earned in zip(trials, returns, strict=True):
            number = plain.integer(trial, 0)
            known[number] = plain.number(earned)
            curve.lineage.append((name, number, known[number], weights, digest, worker, time))
        for _ in range(len(known) - _EPISODES):
            del known[min(known)]
        self._touch(curve)
        return len(trials)

    def _touch(self, curve: Curve) -> None:
        if not curve.dirty:
            curve.dirty = True
            self._dirty.append(curve)

    def quarantined(self, identity: Identity, cause: str) -> None:
        """The run goes on without the variation of which this is a trial."""
        curve = self._curves.get((identity.task, identity.variation))
        if curve is not None:
            curve.quarantine = cause
            self._touch(curve)

    def drawn(self, identity: Identity, message: dict[str, Any]) -> None:
        """An episode to be drawn; of a variation the newest is kept."""
        place = identity.task, identity.variation
        drawing = sketch.of(message)
        self._episodes.pop(place, None)
        told = {
            "name": f"{place[0]}/{place[1]}",
            "identity": "/".join(map(str, identity)),
            "worker": plain.text(message.get("worker")),
            "episode_return": plain.number(message.get("episode_return")),
            "time": plain.when(message.get("time")),
        }
        self._episodes[place] = {**told, "drawing": drawing, "seq": self._next}
        if len(self._episodes) > _DRAWN:
            self._episodes.popitem(last=False)

    def tick(self, seq: int) -> None:
        """Look up some optima, and let some of what has changed be told as of ``seq``."""
        self._next = seq + 1
        for _ in range(min(_OPTIMA, len(self._unsolved))):
            curve = self._unsolved.popleft()
            curve.optimum = sketch.optimum(curve.problem, curve.task, curve.adversary)
            if curve.optimum is not None:
                self._touch(curve)
        for _ in range(min(_TOLD, len(self._dirty))):
            curve = self._dirty.popleft()
            curve.dirty, curve.changed = False, seq

    def changed(self, since: int) -> tuple[list[dict[str, Any]], int]:
        """The variations that changed after ``since``, and how many were left out for want of room."""
        return [_told(place, c) for place, c in sorted(self._curves.items()) if c.changed > since], len(self._left_out)

    def episodes(self, since: int) -> list[dict[str, Any]]:
        """Episodes to be drawn that came after ``since``, the oldest first."""
        return [episode for episode in self._episodes.values() if episode["seq"] > since]

    def detail(self, name: str) -> dict[str, Any] | None:
        """All that is kept of a variation."""
        task, _, variation = name.partition("/")
        if not (task.isascii() and task.isdigit() and variation.isascii() and variation.isdigit() and len(name) < 24):
            return None
        place = int(task), int(variation)
        curve = self._curves.get(place)
        if curve is None:
            return None
        return {
            **_told(place, curve),
            "lineage": [_origin(place, *one) for one in curve.lineage],
            "episode": self._episodes.get(place),
        }


@functools.lru_cache(maxsize=VARIATIONS)
def _of_variation(name: str) -> Identity:
    """``STAGE/ROUND/TASK/VARIATION`` as the identity of its first trial.  Raises Odd for anything else."""
    return plain.identity(f"{name}/0")


def _origin(
    place: tuple[int, int], phase: str, trial: int, earned: float, weights: int, digest: str, worker: str, time: float
) -> dict[str, Any]:
    said = {"weights": weights, "digest": digest, "worker": worker, "time": time}
    return {"identity": f"{phase}/{place[0]}/{place[1]}/{trial}", "episode_return": earned, **said}


def _told(place: tuple[int, int], curve: Curve) -> dict[str, Any]:
    return {
        "name": f"{place[0]}/{place[1]}",
        "task": place[0],
        "variation": place[1],
        "problem": curve.problem,
        "parameters": curve.task,
        "adversary": curve.adversary,
        "optimum": curve.optimum,
        "quarantine": curve.quarantine,
        "phases": [{"name": name, **_columns(returns)} for name, returns in curve.phases.items()],
    }


def _columns(returns: dict[int, float]) -> dict[str, list[Any]]:
    trials = sorted(returns)
    return {"trials": trials, "returns": [round(returns[trial], 4) for trial in trials]}
