"""What a run's overseer should be woken for, by thresholds of the run file."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from icrl_dist.config.sections import AlertsConfig

_PAIRS = 20
"""Trials that two versions must have in common before their returns are compared."""
_MOST = 200_000
"""Returns remembered of a version; beyond them no more pairs are formed."""
_SHOWN = 3
_AGAIN_S = 30.0
"""An alert whose words change is told of again after so long at the earliest: logs are read by people."""
_WINDOW_S = 10.0
"""The time over which ingest is compared with demand, seconds."""


@dataclass(frozen=True)
class Alert:
    """Something that is wrong, or that is over; told as it begins, in other words if they change, and as it ends."""

    name: str
    active: bool
    text: str


@dataclass
class On:
    """An alert that is on."""

    name: str
    text: str
    """As it is now."""
    since: float
    """Unix seconds."""
    told: tuple[str, float]
    """In which words it was told of last, and when."""


class Alerts:
    """Watches a run's numbers; ``check`` gives what has changed since it was last asked."""

    def __init__(self, config: AlertsConfig) -> None:
        self._config = config
        self._on: dict[str, On] = {}
        self._zeros: dict[tuple[int, int], int] = {}
        self._returns: dict[int, dict[tuple[int, int, int], float]] = {}
        self._agreement: dict[int, float] = {}
        self._waited: deque[tuple[float, dict[str, float]]] = deque()

    def returned(self, place: tuple[int, int, int], version: int, value: float) -> None:
        """``version`` acted in trial ``place`` (task, variation, trial) and earned ``value``; -1 for no version."""
        variation = place[:2]
        self._zeros[variation] = self._zeros.get(variation, 0) + 1 if value == 0 else 0
        if version < 0:
            return
        kept = self._returns.setdefault(version, {})
        if len(kept) < _MOST:
            kept[place] = value
        for old in sorted(self._returns)[:-2]:
            del self._returns[old]

    def began(self) -> None:
        """A phase begins: what was 0 before does not count."""
        self._zeros.clear()
        self._waited.clear()

    def labels(self, round: int, agreement: float) -> None:
        """So large a share of a round's labels are optimal."""
        self._agreement[round] = agreement

    def waited(self, now: float, seconds: Mapping[str, float]) -> None:
        """So long has each worker waited, in all, for the learner to store what it sent."""
        self._waited.append((now, dict(seconds)))
        while len(self._waited) > 2 and now - self._waited[1][0] >= _WINDOW_S:
            self._waited.popleft()

    @property
    def on(self) -> list[On]:
        """Those that are on, as the last check found them."""
        return list(self._on.values())

    def check(self, silent: Mapping[str, float], now: float) -> list[Alert]:
        """What began, ended, or is put in other words than when it was last told of.

        ``silent``: seconds since each worker was heard of; ``now``: Unix seconds.
        """
        found = dict(filter(None, (self._collapsed(), self._zero(), self._ingest(), self._labels())))
        for worker, seconds in silent.items():
            if 0 < self._config.silent_s < seconds:
                found[f"silent {worker}"] = f"worker {worker} has not been heard of for {self._config.silent_s:g} s"
        ended = [name for name in self._on if name not in found]
        changed = [Alert(name, False, f"over: {self._on.pop(name).text}") for name in ended]
        for name, text in found.items():
            on = self._on.setdefault(name, On(name, text, now, ("", float("-inf"))))
            on.text = text
            if text != on.told[0] and not 0 <= now - on.told[1] < _AGAIN_S:
                on.told = text, now
                changed.append(Alert(name, True, text))
        return changed

    def _collapsed(self) -> tuple[str, str] | None:
        if len(self._returns) < 2 or not self._config.collapse:
            return None
        old, new = sorted(self._returns)
        pairs = self._returns[old].keys() & self._returns[new].keys()
        before, after = (sum(self._returns[v][place] for place in pairs) for v in (old, new))
        if len(pairs) < _PAIRS or not after < self._config.collapse * before:
            return None
        means = f"{after / len(pairs):.1f}, T^{old} {before / len(pairs):.1f}"
        return "collapse", f"returns collapsed after an update: T^{new} earns {means} in the same {len(pairs)} trials"

    def _zero(self) -> tuple[str, str] | None:
        limit = self._config.zero_episodes
        stuck = [f"{task}/{variation}" for (task, variation), count in self._zeros.items() if 0 < limit <= count]
        if not stuck:
            return None
        names = ", ".join(stuck[:_SHOWN]) + (f" and {len(stuck) - _SHOWN} more" if len(stuck) > _SHOWN else "")
        return "zero", f"stuck at zero for {limit} episodes: variation {names}"

    def _ingest(self) -> tuple[str, str] | None:
        if len(self._waited) < 2 or self._waited[-1][0] - self._waited[0][0] < _WINDOW_S:
            return None
        (then, before), (now, after) = self._waited[0], self._waited[-1]
        throughout = before.keys() & after.keys()
        spent = len(throughout) * (now - then)
        idle = sum(after[worker] - before[worker] for worker in throughout)
        if not spent - idle < self._config.ingest * spent:
            return None
        share = min(1.0, idle / spent)
        return "ingest", f"ingest below demand: workers wait {share:.0%} of their time for the learner to store what they sent"

    def _labels(self) -> tuple[str, str] | None:
        newest = max(self._agreement, default=0)
        before, after = self._agreement.get(newest - 1), self._agreement.get(newest)
        if before is None or after is None or not 0 < self._config.labels <= before - after:
            return None
        return (
            "labels",
            f"label quality falls: {after:.0%} of round {newest}'s labels are optimal, {before:.0%} of round {newest - 1}'s",
        )
