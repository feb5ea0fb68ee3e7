"""Reporter: sends the events of a run to the terminal, to the monitor plane, and to the metrics file."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from icrl_dist.config.run import Run
from icrl_dist.interfaces import LabelQuality, Phase
from icrl_dist.problems import registry
from icrl_dist.stream import wire
from icrl_dist.stream.link import Link, LinkError, StreamKeys
from icrl_dist.telemetry.about import about
from icrl_dist.telemetry.alerts import Alerts
from icrl_dist.telemetry.metrics import Metrics
from icrl_dist.types import Job, Trajectory

_log = logging.getLogger(__name__)

PERIOD_S = 0.25
"""Seconds between two progress messages."""
_DESCRIPTION_S = 2.0
"""Seconds between two descriptions of the run; they repeat for viewers that connect later."""
_MAX_ALERTS = 200
"""Number of active alerts in a description."""
_INGEST_S, _MAX_INGEST_S = 1.0, 60.0
"""Least and largest number of seconds between two rows of ingest metrics."""
_INGEST_ROWS = 3600
"""Rows of ingest metrics in the first hour; later rows are this share of the run's time apart, so that the file stays small."""


class Reporter:
    """Sends each event once to every destination; any thread may call it."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        link: Link,
        keys: StreamKeys,
        metrics: Metrics,
        report: Callable[[dict[str, Any]], None],
        version: Callable[[], int],
    ) -> None:
        """``report`` receives events for the terminal; ``version`` returns the newest policy version."""
        self._run, self._link, self._keys, self._metrics, self._report = run, link, keys, metrics, report
        self._began = (folder / "run.toml").stat().st_mtime if (folder / "run.toml").exists() else time.time()
        self._alerts = Alerts(run.alerts)
        self._lock = threading.Lock()
        self._description: dict[str, Any] = {}
        self._version = version
        self._last_sent = dict.fromkeys(("progress", "description", "ingest", "served"), float("-inf"))
        self._rows: deque[tuple[float, str, dict[str, Any]]] = deque()
        """Rows (Unix time, stage, fields) for the metrics file, which only the thread of the run writes."""

    def event(self, event: dict[str, Any]) -> None:
        """Send an event everywhere: ``event["event"]`` is its kind, ``event["text"]`` a sentence for the user."""
        self._report(event)
        if "text" in event:
            fields = {name: event[name] for name in ("worker", "alive", "identity") if name in event}
            self.log(event["event"], event["text"], **fields)

    def log(self, what: str, text: str, **fields: Any) -> None:
        """Send an event to monitors and metrics, but not to the terminal, which has a text of its own for it."""
        now = time.time()
        self._rows.append((now, "event", {"what": what, "text": text, **fields}))
        self._publish("event", "event", now, what=what, text=text, **fields)

    def describe(self, phases: Sequence[Phase], jobs: Sequence[Job]) -> None:
        """Set the description of the run, which is published repeatedly."""
        self._description = {**about(self._run, phases, jobs), "began": self._began}
        self._last_sent["description"] = float("-inf")

    def phase_started(self) -> None:
        """Reset the alerts at the start of a phase's collection."""
        with self._lock:
            self._alerts.begin_phase()

    def stored(self, trajectory: Trajectory) -> None:
        """Pass the return of a stored trajectory to the alerts."""
        identity = trajectory.identity
        if identity.stage == "adapt" or registry.of(self._run).earns_in_contexts:
            trial = identity.task, identity.variation, identity.trial
            with self._lock:
                self._alerts.add_return(trial, trajectory.policy_version, trajectory.episode_return)

    def fitted(self, loss: float, seconds: float) -> None:
        """Report that the newest policy version is fitted and published."""
        version = self._version()
        self._metrics.write(version, "version", loss=loss, seconds=seconds)
        self.log("version", f"T^{version} is fitted: loss {loss:.3f}, {seconds:.0f} s", version=version)

    def diverged(self, text: str) -> None:
        """Report as an alert that a fit diverged; the run ends."""
        self._report({"event": "alert", "text": f"ALERT: {text}"})
        self._rows.append((time.time(), "alert", {"what": "diverged", "active": True, "text": text}))
        self._publish("event", "event", what="alert", alert="diverged", active=True, text=text)

    def labels_rated(self, round: int, quality: LabelQuality) -> None:
        """Report the quality of a round's self-made labels."""
        fields = dataclasses.asdict(quality)
        self._metrics.write(round, "labels", **fields)
        optimal = f"{quality.agreement:.0%} optimal"
        text = f"labels of adapt/{round}: {optimal}; return {quality.label_return:.1f} in the labeling trials"
        self._report({"event": "labels", "round": round, **fields})
        self.log("labels", text)
        with self._lock:
            self._alerts.add_label_quality(round, quality.agreement)

    def progress(self, fields: dict[str, Any], force: bool, totals: Mapping[str, Any]) -> None:
        """Send the progress of a phase, if ``force`` is set or ``PERIOD_S`` have passed.

        ``fields`` as in docs/tap.md; ``totals`` as in ``WorkerAPI.totals``.
        """
        if not self._due("progress", PERIOD_S) and not force:
            return
        self._report({"event": "progress", **fields})
        self._publish("learner", "learner", **fields)
        if self._description and self._due("description", _DESCRIPTION_S):
            self._publish("run", "run", **self._description, alerts=self._active_alerts())
        if fields["stage"] == "collect":
            keep = self._due("ingest", self._ingest_period()) or force
            if self._due("served", _INGEST_S) or keep:
                self._write_ingest(fields, totals, keep)
        self._check_alerts(fields, totals)
        self.flush()

    def _ingest_period(self) -> float:
        return min(_MAX_INGEST_S, max(_INGEST_S, (time.time() - self._began) / _INGEST_ROWS))

    def _write_ingest(self, fields: dict[str, Any], totals: Mapping[str, Any], keep: bool) -> None:
        self._metrics.write(
            0 if fields["phase"] == "pretrain" else fields["round"] + 1,
            "ingest",
            keep=keep,
            trajectories=fields["trajectories"],
            arrived=fields["step"],
            episodes=totals["episodes"],
            workers=fields["workers"],
            unstored=max(0, totals["episodes"] - totals["acknowledged"]),
            lag=fields["lag"],
            drops=sum(fields["drops"].values()),
            resent=totals["resent"],
            waited_s=totals["waited_s"],
        )

    def _check_alerts(self, fields: dict[str, Any], totals: Mapping[str, Any]) -> None:
        now = time.time()
        with self._lock:
            if fields["stage"] == "collect":
                self._alerts.add_waiting(time.monotonic(), totals["waited"])
            changed = self._alerts.check(totals["silent"], now)
        for alert in changed:
            self._report({"event": "alert", "text": f"{'ALERT' if alert.active else 'alert'}: {alert.text}"})
            self._rows.append((now, "alert", {"what": alert.name, "active": alert.active, "text": alert.text}))
            about = {"alert": alert.name, "active": alert.active, "text": alert.text}
            self._publish("event", "event", now, what="alert", **about)

    def _active_alerts(self) -> list[dict[str, Any]]:
        """The active alerts; they repeat for viewers that connect later or missed a change."""
        with self._lock:
            return [{"name": on.name, "text": on.text, "since": on.since} for on in self._alerts.active[:_MAX_ALERTS]]

    def flush(self) -> None:
        """Write all rows so far into the metrics file.  Raises StoreError if it cannot be written."""
        while self._rows:
            at, stage, fields = self._rows.popleft()
            self._metrics.write_text(at, self._version(), stage, **fields)

    def _due(self, what: str, period_s: float) -> bool:
        now = time.monotonic()
        if now - self._last_sent[what] < period_s:
            return False
        self._last_sent[what] = now
        return True

    def _publish(self, topic: str, kind: str, now: float | None = None, **fields: Any) -> None:
        message = wire.encode_message(kind, time=time.time() if now is None else now, **fields)
        try:
            self._link.publish(self._keys.monitor(topic), message, droppable=True)
        except LinkError as error:
            _log.warning("a %s message was not published to monitors: %s", kind, error)
