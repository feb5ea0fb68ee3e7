"""Alerts: conditions of a run that a person should look at, by thresholds of the run file."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from icrl_dist.config.sections import AlertsConfig

_PAIRS = 20
"""Trials that two versions must share before their returns are compared."""
_MAX_RETURNS = 200_000
"""Returns kept of a version; later ones are not compared."""
_MAX_NAMED = 3
_REPEAT_S = 30.0
"""Seconds before an active alert is reported again because its text has changed."""
_WINDOW_S = 10.0
"""Seconds over which the workers' waiting time is measured."""
_BURST, _EVERY_S = 50, 10.0
"""Reports of alerts that begin or change: so many at once, then one in so many seconds."""

KINDS = ("collapse", "zero", "ingest", "labels", "silent", "other")
"""What the name of an alert begins with."""


def alert_kind(name: str) -> str:
    """The kind of an alert: ``silent`` for ``silent w0``."""
    kind = name.partition(" ")[0]
    return kind if kind in KINDS else "other"


@dataclass(frozen=True)
class Alert:
    """A change of an alert: it began, its text changed, or it ended."""

    name: str
    active: bool
    text: str


@dataclass
class ActiveAlert:
    """An alert whose condition holds."""

    name: str
    text: str
    """The current text."""
    since: float
    """Unix seconds."""
    reported: tuple[str, float]
    """The text of the last report, and its time."""


class Alerts:
    """Collects the numbers that alerts depend on; ``check`` returns the changes since its last call."""

    def __init__(self, config: AlertsConfig) -> None:
        self._config = config
        self._active: dict[str, ActiveAlert] = {}
        self._zeros: dict[tuple[int, int], int] = {}
        self._returns: dict[int, dict[tuple[int, int, int], float]] = {}
        self._agreement: dict[int, float] = {}
        self._waited: deque[tuple[float, dict[str, float]]] = deque()
        self._allowed, self._allowed_at = float(_BURST), 0.0

    def add_return(self, place: tuple[int, int, int], version: int, value: float) -> None:
        """Policy ``version`` (-1 for none) had the return ``value`` in trial ``place``: task, variation, trial."""
        variation = place[:2]
        self._zeros[variation] = self._zeros.get(variation, 0) + 1 if value == 0 else 0
        if version < 0:
            return
        kept = self._returns.setdefault(version, {})
        if len(kept) < _MAX_RETURNS:
            kept[place] = value
        for old in sorted(self._returns)[:-2]:
            del self._returns[old]

    def begin_phase(self) -> None:
        """A phase begins: forget the zero returns and waiting times of the last one."""
        self._zeros.clear()
        self._waited.clear()

    def add_label_quality(self, round: int, agreement: float) -> None:
        """The share of a round's labels that are optimal."""
        self._agreement[round] = agreement

    def add_waiting(self, now: float, seconds: Mapping[str, float]) -> None:
        """The seconds that each worker has waited so far for the learner to store its trajectories, at time ``now``."""
        self._waited.append((now, dict(seconds)))
        while len(self._waited) > 2 and now - self._waited[1][0] >= _WINDOW_S:
            self._waited.popleft()

    @property
    def active(self) -> list[ActiveAlert]:
        """The alerts that were active at the last check."""
        return list(self._active.values())

    def check(self, silent: Mapping[str, float], now: float) -> list[Alert]:
        """The alerts that began, ended, or have another text than in their last report.

        A storm of alerts is reported in part (``_BURST``); ``active`` has all of them.  ``silent``: seconds since each
        worker's last message; ``now``: Unix seconds.
        """
        found = dict(filter(None, (self._collapsed(), self._zero(), self._ingest(), self._labels())))
        for worker, seconds in silent.items():
            if 0 < self._config.silent_s < seconds:
                found[f"silent {worker}"] = f"worker {worker} has been silent for {self._config.silent_s:g} s"
        ended = [self._active.pop(name) for name in list(self._active) if name not in found]
        changed = [Alert(alert.name, False, f"over: {alert.text}") for alert in ended if alert.reported[0]]
        for name, text in found.items():
            alert = self._active.setdefault(name, ActiveAlert(name, text, now, ("", float("-inf"))))
            alert.text = text
            if text != alert.reported[0] and not 0 <= now - alert.reported[1] < _REPEAT_S and self._allows(now):
                alert.reported = text, now
                changed.append(Alert(name, True, text))
        return changed

    def _allows(self, now: float) -> bool:
        """Whether one more report is allowed; one that is not is made later if its alert is still active."""
        self._allowed = min(_BURST, self._allowed + max(0.0, now - self._allowed_at) / _EVERY_S)
        self._allowed_at = now
        if self._allowed < 1:
            return False
        self._allowed -= 1
        return True

    def _collapsed(self) -> tuple[str, str] | None:
        if len(self._returns) < 2 or not self._config.collapse:
            return None
        old, new = sorted(self._returns)
        pairs = self._returns[old].keys() & self._returns[new].keys()
        before, after = (sum(self._returns[v][place] for place in pairs) for v in (old, new))
        if len(pairs) < _PAIRS or not after < self._config.collapse * before:
            return None
        means = f"{after / len(pairs):.1f}, T^{old} {before / len(pairs):.1f}"
        return "collapse", f"returns collapsed after an update: T^{new} returns {means} in the same {len(pairs)} trials"

    def _zero(self) -> tuple[str, str] | None:
        limit = self._config.zero_episodes
        stuck = [f"{task}/{variation}" for (task, variation), count in self._zeros.items() if 0 < limit <= count]
        if not stuck:
            return None
        names = ", ".join(stuck[:_MAX_NAMED]) + (f" and {len(stuck) - _MAX_NAMED} more" if len(stuck) > _MAX_NAMED else "")
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
        return (
            "ingest",
            f"ingest below demand: workers wait {share:.0%} of their time for the learner to store their trajectories",
        )

    def _labels(self) -> tuple[str, str] | None:
        newest = max(self._agreement, default=0)
        before, after = self._agreement.get(newest - 1), self._agreement.get(newest)
        if before is None or after is None or not 0 < self._config.labels <= before - after:
            return None
        return (
            "labels",
            f"label quality falls: {after:.0%} of adapt/{newest}'s labels are optimal, {before:.0%} of adapt/{newest - 1}'s",
        )
