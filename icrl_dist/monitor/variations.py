"""Returns of every variation over its episodes, and sampled episodes as drawings.

What is kept does not depend on the order in which messages arrive: a view that joins late receives old returns after new ones.
"""

from __future__ import annotations

import functools
from collections import OrderedDict, deque
from typing import Any, NamedTuple

from icrl_dist.monitor import averages, validation
from icrl_dist.monitor import drawing as drawings
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.types import STAGES, Identity

MAX_VARIATIONS = 4096
"""Variations that are kept; further ones are only counted."""
_MAX_RETURNS = 256
"""Returns kept for each phase of a variation, the newest."""
_MAX_PHASES = 3
"""Phases kept for each variation, the newest."""
_MAX_LINEAGE = 32
_MAX_ENTRIES = 4096
"""Limit on the episodes of one variation in one message."""
_MAX_DRAWINGS = 48
_OPTIMA_PER_TICK = 4
"""Each optimum takes some milliseconds to compute."""
_PROMPT = 500
"""Up to this many variations, averages are computed for every snapshot."""
_CHANGES_PER_TICK = 200
"""Limit on the variations that become part of one change; the remaining ones follow at later ticks."""


Pair = tuple[int, int]
"""A variation as (task, variation), or a phase as (stage, round)."""


class VariationInfo(NamedTuple):
    """Problem, task and adversary of a variation in one phase."""

    problem: str
    task: dict[str, Any]
    adversary: dict[str, Any]

    @classmethod
    def from_message(cls, entry: dict[str, Any]) -> VariationInfo:
        """Parse an entry of ``variations`` (docs/tap.md).  Raises InvalidMessageError."""
        return cls(
            validation.text(entry.get("problem"), 64),
            validation.parameters(entry.get("task")),
            validation.parameters(entry.get("adversary")),
        )


_UNKNOWN = VariationInfo("", {}, {})


class PhaseReturns:
    """One phase of a variation.  ICAA draws the adversary anew in every round, so the optimum differs by phase."""

    __slots__ = ("info", "name", "optimum", "pending", "quarantine", "returns")

    def __init__(self, name: str) -> None:
        self.name = name
        self.info: VariationInfo | None = None
        self.optimum: float | None = None
        self.pending = False
        """Whether the optimum is not computed yet."""
        self.quarantine = ""
        """Why the variation was quarantined in this phase; may be set before any episode arrives."""
        self.returns: dict[int, float] = {}


class VariationReturns:
    """The phases of one variation and the lineage of its newest episodes."""

    __slots__ = ("changed", "dirty", "lineage", "phases")

    def __init__(self) -> None:
        self.phases: dict[Pair, PhaseReturns] = {}
        """By (stage, round)."""
        self.lineage: dict[tuple[Pair, int], tuple[str, int, float, int, str, str, float]] = {}
        """The newest episodes, by phase and trial."""
        self.changed = 0
        """``seq`` of the newest change that snapshots contain."""
        self.dirty = False
        """Whether it changed since then."""

    def phase(self, identity: Identity, begun: Pair) -> PhaseReturns:
        """The phase of ``identity``, added if needed.

        Beyond the limit one is removed, perhaps this one: a round after ``begun`` (it may be wrong), or the oldest.
        """
        key = _phase_key(identity)
        found = self.phases.setdefault(key, PhaseReturns(f"{identity.stage}/{identity.round}"))
        if len(self.phases) > _MAX_PHASES:
            del self.phases[min(self.phases, key=lambda key: (key <= begun, key))]
        return found


class VariationTable:
    """A table of variations named ``TASK/VARIATION``, with a limit on their number."""

    def __init__(self) -> None:
        self._variations: dict[Pair, VariationReturns] = {}
        self._left_out: set[Pair] = set()
        self._unsolved: OrderedDict[tuple[Pair, Pair], None] = OrderedDict()
        """Variations and phases whose optimum is not computed yet."""
        self._dirty: deque[VariationReturns] = deque()
        self._episodes: OrderedDict[Pair, dict[str, Any]] = OrderedDict()
        self._next_seq = 1
        self._averages: list[dict[str, Any]] = []
        self.begun: Pair = len(STAGES), 0
        """The last phase that may have begun; after all others while it is unknown."""
        self.collecting: Pair | None = None
        """The phase whose returns are arriving."""
        self._averaged = True
        """Whether these are the averages of the present returns and optima."""

    def __len__(self) -> int:
        """Number of variations in messages so far, those beyond the limit included."""
        return len(self._variations) + len(self._left_out)

    def add_returns(self, entry: dict[str, Any], worker: str, time: float) -> int:
        """Add the finished episodes of an entry of ``variations`` (docs/tap.md); returns their number.

        Raises InvalidMessageError.
        """
        identity = _first_identity(validation.text(entry.get("identity"), 120))
        trials = [validation.integer(trial, 0) for trial in validation.bounded_list(entry.get("trials"), _MAX_ENTRIES)]
        returns = validation.numbers(entry.get("returns"), _MAX_ENTRIES)
        if len(trials) != len(returns):
            raise InvalidMessageError("schema")
        version, digest = validation.integer(entry.get("policy_version"), -1), validation.text(entry.get("weights_digest"), 64)
        key, phase_key = (identity.task, identity.variation), _phase_key(identity)
        known = self._variations[key].phases.get(phase_key) if key in self._variations else None
        info = known.info if known is not None and known.info is not None else VariationInfo.from_message(entry)
        variation = self._variation(key)
        phase = variation.phase(identity, self.begun)
        if phase.info is None:
            phase.info, phase.pending = info, True
            self._unsolved[key, phase_key] = None
            if len(self._unsolved) > _MAX_PHASES * MAX_VARIATIONS:
                self._unsolved.popitem(last=False)
        for trial, episode_return in zip(trials, returns, strict=True):
            phase.returns[trial] = episode_return
            variation.lineage[phase_key, trial] = phase.name, trial, episode_return, version, digest, worker, time
        for _ in range(len(variation.lineage) - _MAX_LINEAGE):
            del variation.lineage[min(variation.lineage, key=lambda key: (key[0] <= self.begun, key))]
        for _ in range(len(phase.returns) - _MAX_RETURNS):
            del phase.returns[min(phase.returns)]
        self._mark_dirty(variation)
        return len(trials)

    def _variation(self, key: Pair) -> VariationReturns:
        """The variation ``key``, added if needed.  Raises InvalidMessageError beyond the limit."""
        if key not in self._variations:
            if len(self._variations) >= MAX_VARIATIONS:
                if len(self._left_out) < 16 * MAX_VARIATIONS:
                    self._left_out.add(key)
                raise InvalidMessageError("too many variations")
            self._variations[key] = VariationReturns()
        return self._variations[key]

    def _mark_dirty(self, variation: VariationReturns) -> None:
        self._averaged = False
        if not variation.dirty:
            variation.dirty = True
            self._dirty.append(variation)

    def set_quarantine(self, identity: Identity, cause: str) -> None:
        """Record why a variation is quarantined in a phase; an empty ``cause`` ends the quarantine.

        ``identity`` is any trial of it, which may never have started.  Raises InvalidMessageError.
        """
        variation = self._variation((identity.task, identity.variation))
        variation.phase(identity, self.begun).quarantine = cause
        self._mark_dirty(variation)

    def add_episode(self, identity: Identity, message: dict[str, Any]) -> None:
        """Add an ``episode`` message as a drawing; the newest of each variation is kept.  Raises InvalidMessageError."""
        key = identity.task, identity.variation
        drawing = drawings.of(message)
        self._episodes.pop(key, None)
        fields = {
            "name": f"{key[0]}/{key[1]}",
            "identity": "/".join(map(str, identity)),
            "worker": validation.text(message.get("worker")),
            "episode_return": validation.number(message.get("episode_return")),
            "time": validation.timestamp(message.get("time")),
        }
        self._episodes[key] = {**fields, "drawing": drawing, "seq": self._next_seq}
        if len(self._episodes) > _MAX_DRAWINGS:
            self._episodes.popitem(last=False)

    def tick(self, seq: int) -> None:
        """Compute some optima, and make some changes visible to snapshots as of ``seq``."""
        self._next_seq = seq + 1
        computed = 0
        while self._unsolved and computed < _OPTIMA_PER_TICK:
            (key, phase_key), _ = self._unsolved.popitem(last=False)
            variation = self._variations[key]
            phase = variation.phases.get(phase_key)
            if phase is not None and phase.info is not None:
                phase.optimum, phase.pending = drawings.optimum(*phase.info), False
                computed += 1
                self._mark_dirty(variation)
        for _ in range(min(_CHANGES_PER_TICK, len(self._dirty))):
            variation = self._dirty.popleft()
            variation.dirty, variation.changed = False, seq

    def changed(self, since: int) -> tuple[list[dict[str, Any]], int]:
        """Rows of the variations that changed after ``since``, and the number of variations beyond the limit."""
        rows = [_row(key, variation) for key, variation in sorted(self._variations.items()) if variation.changed > since]
        return rows, len(self._left_out)

    def averages(self) -> list[dict[str, Any]]:
        """See ``averages.of_newest``.  Of many variations they are computed at every eighth tick only."""
        if not self._averaged and (len(self._variations) <= _PROMPT or self._next_seq % 8 == 0):
            self._averaged = True
            phases = (variation.phases for variation in self._variations.values())
            limits = _MAX_PHASES, _MAX_RETURNS
            self._averages = averages.of_newest(phases, self.begun, self.collecting, limits)
        return self._averages

    def complete(self, expected: int, phases: int) -> bool:
        """Whether every one of ``expected`` variations has as many phases as are kept, after ``phases`` were requested."""
        full = sum(len(variation.phases) >= _MAX_PHASES for variation in self._variations.values())
        return phases >= _MAX_PHASES and full >= expected > 0

    def episodes(self, since: int) -> list[dict[str, Any]]:
        """Drawn episodes that arrived after ``since``, oldest first."""
        return [episode for episode in self._episodes.values() if episode["seq"] > since]

    def detail(self, name: str) -> dict[str, Any] | None:
        """Everything kept of a variation: its row, lineage and newest episode; None if it is unknown."""
        task, _, variation = name.partition("/")
        if not (task.isascii() and task.isdigit() and variation.isascii() and variation.isdigit() and len(name) < 24):
            return None
        key = int(task), int(variation)
        found = self._variations.get(key)
        if found is None:
            return None
        return {
            **_row(key, found),
            "lineage": [_lineage_entry(key, *entry) for _, entry in sorted(found.lineage.items())],
            "episode": self._episodes.get(key),
        }


@functools.lru_cache(maxsize=MAX_VARIATIONS)
def _first_identity(name: str) -> Identity:
    """Identity of the first trial of ``STAGE/ROUND/TASK/VARIATION``.  Raises InvalidMessageError."""
    return validation.identity(f"{name}/0")


def _lineage_entry(
    key: Pair, phase: str, trial: int, episode_return: float, version: int, digest: str, worker: str, time: float
) -> dict[str, Any]:
    origin = {"policy_version": version, "weights_digest": digest, "worker": worker, "time": time}
    return {"identity": f"{phase}/{key[0]}/{key[1]}/{trial}", "episode_return": episode_return, **origin}


def _phase_key(identity: Identity) -> Pair:
    return STAGES.index(identity.stage), identity.round


def _row(key: Pair, variation: VariationReturns) -> dict[str, Any]:
    phases = [phase for _, phase in sorted(variation.phases.items())]
    newest = phases[-1]
    info = newest.info or _UNKNOWN
    return {
        "name": f"{key[0]}/{key[1]}",
        "task": key[0],
        "variation": key[1],
        "problem": info.problem,
        "parameters": info.task,
        "adversary": info.adversary,
        "optimum": newest.optimum,
        "quarantine": newest.quarantine,
        "phases": [_phase_row(phase) for phase in phases],
    }


def _phase_row(phase: PhaseReturns) -> dict[str, Any]:
    trials = sorted(phase.returns)
    returns = [round(phase.returns[trial], 4) for trial in trials]
    adversary = (phase.info or _UNKNOWN).adversary
    return {
        "name": phase.name,
        "adversary": adversary,
        "optimum": phase.optimum,
        "pending": phase.pending,
        "trials": trials,
        "returns": returns,
    }
