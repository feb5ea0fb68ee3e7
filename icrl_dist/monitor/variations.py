"""Adaptation, variation by variation: returns over episodes, and some episodes to be drawn."""

from __future__ import annotations

import functools
from collections import OrderedDict, deque
from typing import Any, NamedTuple

from icrl_dist.monitor import drawing as sketch
from icrl_dist.monitor import validation
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.types import STAGES, Identity

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


Place = tuple[int, int]
"""A variation, as task and variation; or a phase, as stage and round."""


class VariationInfo(NamedTuple):
    """What a variation is in one phase."""

    problem: str
    task: dict[str, Any]
    adversary: dict[str, Any]

    @classmethod
    def from_message(cls, told: dict[str, Any]) -> VariationInfo:
        """As an entry of ``variations`` in docs/tap.md tells it."""
        return cls(
            validation.text(told.get("problem"), 64),
            validation.parameters(told.get("task")),
            validation.parameters(told.get("adversary")),
        )


_NOTHING = VariationInfo("", {}, {})


class PhaseReturns:
    """One phase of a variation: ICAA draws its adversary anew every round, and with it the optimum."""

    __slots__ = ("about", "name", "optimum", "quarantine", "returns")

    def __init__(self, name: str) -> None:
        self.name = name
        self.about: VariationInfo | None = None
        self.optimum: float | None = None
        self.quarantine = ""
        """Why the run goes on without it; nothing may be known of it but that."""
        self.returns: dict[int, float] = {}


class VariationReturns:
    """One variation: what it is in each phase, and what was earned in it."""

    __slots__ = ("changed", "dirty", "lineage", "parts")

    def __init__(self) -> None:
        self.parts: dict[Place, PhaseReturns] = {}
        """By stage and round, as they were heard of; a few."""
        self.lineage: deque[tuple[str, int, float, int, str, str, float]] = deque(maxlen=_LINEAGE)
        self.changed = 0
        self.dirty = False

    def part(self, identity: Identity) -> PhaseReturns:
        """Its part in that phase, from now on; of many, the one that was heard of first makes room."""
        phase = _phase(identity)
        if phase not in self.parts:
            if len(self.parts) >= _PHASES:
                del self.parts[next(iter(self.parts))]
            self.parts[phase] = PhaseReturns(f"{identity.stage}/{identity.round}")
        return self.parts[phase]


class VariationTable:
    """A bounded table of variations, named ``TASK/VARIATION``."""

    def __init__(self) -> None:
        self._curves: dict[Place, VariationReturns] = {}
        self._left_out: set[Place] = set()
        self._unsolved: OrderedDict[tuple[Place, Place], None] = OrderedDict()
        """Variations and phases whose optimum has still to be looked up."""
        self._dirty: deque[VariationReturns] = deque()
        self._episodes: OrderedDict[Place, dict[str, Any]] = OrderedDict()
        self._next = 1

    def __len__(self) -> int:
        """Variations that were heard of."""
        return len(self._curves) + len(self._left_out)

    def returned(self, told: dict[str, Any], worker: str, time: float) -> int:
        """Episodes of a variation ended: as in an entry of ``variations`` in docs/tap.md; how many."""
        identity = _of_variation(validation.text(told.get("identity"), 120))
        trials = [validation.integer(trial, 0) for trial in validation.bounded_list(told.get("trials"), _TOGETHER)]
        returns = validation.numbers(told.get("returns"), _TOGETHER)
        if len(trials) != len(returns):
            raise InvalidMessageError("schema")
        weights, digest = validation.integer(told.get("policy_version"), -1), validation.text(told.get("weights_digest"), 64)
        place, phase = (identity.task, identity.variation), _phase(identity)
        known = self._curves[place].parts.get(phase) if place in self._curves else None
        about = known.about if known is not None and known.about is not None else VariationInfo.from_message(told)
        curve = self._curve(place)
        part = curve.part(identity)
        if part.about is None:
            part.about = about
            self._unsolved[place, phase] = None
            if len(self._unsolved) > _PHASES * VARIATIONS:
                self._unsolved.popitem(last=False)
        for trial, earned in zip(trials, returns, strict=True):
            part.returns[trial] = earned
            curve.lineage.append((part.name, trial, earned, weights, digest, worker, time))
        for _ in range(len(part.returns) - _EPISODES):
            del part.returns[min(part.returns)]
        self._touch(curve)
        return len(trials)

    def _curve(self, place: Place) -> VariationReturns:
        """That of a variation, from now on.  Raises InvalidMessageError if there are too many."""
        if place not in self._curves:
            if len(self._curves) >= VARIATIONS:
                if len(self._left_out) < 16 * VARIATIONS:
                    self._left_out.add(place)
                raise InvalidMessageError("too many variations")
            self._curves[place] = VariationReturns()
        return self._curves[place]

    def _touch(self, curve: VariationReturns) -> None:
        if not curve.dirty:
            curve.dirty = True
            self._dirty.append(curve)

    def quarantined(self, identity: Identity, cause: str) -> None:
        """In that phase the run goes on without the variation of which this is a trial, and which it may never have begun.

        Without a ``cause`` it goes on with it after all.
        """
        curve = self._curve((identity.task, identity.variation))
        curve.part(identity).quarantine = cause
        self._touch(curve)

    def drawn(self, identity: Identity, message: dict[str, Any]) -> None:
        """An episode to be drawn; of a variation the newest is kept."""
        place = identity.task, identity.variation
        drawing = sketch.of(message)
        self._episodes.pop(place, None)
        told = {
            "name": f"{place[0]}/{place[1]}",
            "identity": "/".join(map(str, identity)),
            "worker": validation.text(message.get("worker")),
            "episode_return": validation.number(message.get("episode_return")),
            "time": validation.timestamp(message.get("time")),
        }
        self._episodes[place] = {**told, "drawing": drawing, "seq": self._next}
        if len(self._episodes) > _DRAWN:
            self._episodes.popitem(last=False)

    def tick(self, seq: int) -> None:
        """Look up some optima, and let some of what has changed be told as of ``seq``."""
        self._next = seq + 1
        for _ in range(min(_OPTIMA, len(self._unsolved))):
            (place, phase), _ = self._unsolved.popitem(last=False)
            curve = self._curves[place]
            part = curve.parts.get(phase)
            if part is not None and part.about is not None:
                part.optimum = sketch.optimum(*part.about)
                if part.optimum is not None:
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
    """``STAGE/ROUND/TASK/VARIATION`` as the identity of its first trial.  Raises InvalidMessageError for anything else."""
    return validation.identity(f"{name}/0")


def _origin(
    place: Place, phase: str, trial: int, earned: float, weights: int, digest: str, worker: str, time: float
) -> dict[str, Any]:
    said = {"policy_version": weights, "weights_digest": digest, "worker": worker, "time": time}
    return {"identity": f"{phase}/{place[0]}/{place[1]}/{trial}", "episode_return": earned, **said}


def _phase(identity: Identity) -> Place:
    return STAGES.index(identity.stage), identity.round


def _told(place: Place, curve: VariationReturns) -> dict[str, Any]:
    parts = [part for _, part in sorted(curve.parts.items())]
    newest = parts[-1]
    about = newest.about or _NOTHING
    return {
        "name": f"{place[0]}/{place[1]}",
        "task": place[0],
        "variation": place[1],
        "problem": about.problem,
        "parameters": about.task,
        "adversary": about.adversary,
        "optimum": newest.optimum,
        "quarantine": newest.quarantine,
        "phases": [_part(part) for part in parts],
    }


def _part(part: PhaseReturns) -> dict[str, Any]:
    trials = sorted(part.returns)
    returns = [round(part.returns[trial], 4) for trial in trials]
    adversary = (part.about or _NOTHING).adversary
    return {"name": part.name, "adversary": adversary, "optimum": part.optimum, "trials": trials, "returns": returns}
