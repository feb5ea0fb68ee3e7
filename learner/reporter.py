"""What the learner says of a run: to its terminal, to the monitor plane, and to the run's metrics."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from icrl_dist.config.run import Run
from icrl_dist.methods.recipes import Phase, about
from icrl_dist.stream import wire
from icrl_dist.stream.link import Link, LinkError, StreamKeys
from icrl_dist.telemetry.alerts import Alerts
from icrl_dist.telemetry.metrics import Metrics
from icrl_dist.types import Job, Trajectory

_log = logging.getLogger(__name__)

Report = Callable[[dict[str, Any]], None]

PERIOD_S = 0.25
"""Progress is told this often."""
_ABOUT_S = 2.0
"""What a run is about is told this often, for viewers that come late."""
_ALERTS = 200
"""Alerts of which monitors are told again, at most."""
_INGEST_S = 1.0


class Herald:
    """Says everything once, to whoever wants to hear it; events may come from any thread."""

    def __init__(
        self, run: Run, folder: Path, link: Link, keys: StreamKeys, metrics: Metrics, report: Report, version: Callable[[], int]
    ) -> None:
        """``version``: the newest of the weights."""
        self._run, self._link, self._keys, self._metrics, self._report = run, link, keys, metrics, report
        self._began = (folder / "run.toml").stat().st_mtime if (folder / "run.toml").exists() else time.time()
        self._alerts = Alerts(run.alerts)
        self._lock = threading.Lock()
        self._about: dict[str, Any] = {}
        self._version = version
        self._told = dict.fromkeys(("progress", "about", "ingest"), float("-inf"))
        self._rows: deque[tuple[float, str, dict[str, Any]]] = deque()  # written by the run's own thread

    def event(self, event: dict[str, Any]) -> None:
        """Something happened: ``event`` names what, ``text`` says it to people."""
        self._report(event)
        if "text" in event:
            about = {name: event[name] for name in ("worker", "alive", "identity") if name in event}
            self.say(event["event"], event["text"], **about)

    def say(self, what: str, text: str, **about: Any) -> None:
        """The same to all but the terminal, which is told in other words."""
        now = time.time()
        self._rows.append((now, "event", {"what": what, "text": text, **about}))
        self._publish("event", "event", now, what=what, text=text, **about)

    def about(self, phases: Sequence[Phase], jobs: Sequence[Job]) -> None:
        """What the run is about: told again from time to time."""
        self._about = {**about(self._run, phases, jobs), "began": self._began}
        self._told["about"] = float("-inf")

    def began(self) -> None:
        """A phase begins to be collected."""
        with self._lock:
            self._alerts.begin_phase()

    def stored(self, trajectory: Trajectory) -> None:
        """A trajectory was stored."""
        identity = trajectory.identity
        if identity.stage == "adapt" or self._run.problem != "darkroom":  # a random walk in the dark may well find nothing
            place = identity.task, identity.variation, identity.trial
            with self._lock:
                self._alerts.add_return(place, trajectory.policy_version, trajectory.episode_return)

    def fitted(self, loss: float, seconds: float) -> None:
        """The newest version of the weights is fitted and published."""
        version = self._version()
        self._metrics.write(version, "version", loss=loss, seconds=seconds)
        self.say("version", f"T^{version} is fitted: loss {loss:.3f}, {seconds:.0f} s", version=version)

    def labelled(self, round: int, quality: Mapping[str, float]) -> None:
        """How good a round's own labels are."""
        self._metrics.write(round, "labels", **quality)
        q = quality
        text = f"labels of round {round}: {q['agreement']:.0%} optimal; return {q['label_return']:.1f} in the trials that label"
        self._report({"event": "labels", "round": round, **quality})
        self.say("labels", text)
        with self._lock:
            self._alerts.add_label_quality(round, quality["agreement"])

    def progress(self, fields: dict[str, Any], force: bool, desk: Mapping[str, Any]) -> None:
        """How far a phase is; told if ``force``, or if it is time.

        ``fields`` as in docs/tap.md; ``desk`` as ``Desk.told``.
        """
        if not self._due("progress", PERIOD_S) and not force:
            return
        self._report({"event": "progress", **fields})
        self._publish("learner", "learner", **fields)
        if self._about and self._due("about", _ABOUT_S):
            self._publish("run", "run", **self._about, alerts=self._on())
        if fields["stage"] == "collect" and (self._due("ingest", _INGEST_S) or force):
            self._ingest(fields, desk)
        self._alert(fields, desk)
        self.write()

    def _ingest(self, fields: dict[str, Any], desk: Mapping[str, Any]) -> None:
        self._metrics.write(
            fields["version"] + 1,
            "ingest",
            trajectories=fields["trajectories"],
            arrived=fields["step"],
            episodes=desk["episodes"],
            workers=fields["workers"],
            unstored=max(0, desk["episodes"] - desk["acknowledged"]),
            lag=fields["lag"],
            drops=sum(fields["drops"].values()),
            resent=desk["resent"],
            waited_s=desk["waited_s"],
        )

    def _alert(self, fields: dict[str, Any], desk: Mapping[str, Any]) -> None:
        now = time.time()
        with self._lock:
            if fields["stage"] == "collect":
                self._alerts.add_waiting(time.monotonic(), desk["waited"])
            changed = self._alerts.check(desk["silent"], now)
        for alert in changed:
            self._report({"event": "alert", "text": f"{'ALERT' if alert.active else 'alert'}: {alert.text}"})
            self._rows.append((now, "alert", {"what": alert.name, "active": alert.active, "text": alert.text}))
            about = {"alert": alert.name, "active": alert.active, "text": alert.text}
            self._publish("event", "event", now, what="alert", **about)

    def _on(self) -> list[dict[str, Any]]:
        """The alerts that are on: told again and again, for viewers that come late or missed how one began or ended."""
        with self._lock:
            return [{"name": on.name, "text": on.text, "since": on.since} for on in self._alerts.active[:_ALERTS]]

    def write(self) -> None:
        """Everything said so far into the metrics.  Raises StoreError if it cannot be written."""
        while self._rows:
            at, stage, about = self._rows.popleft()
            self._metrics.write_text(at, self._version(), stage, **about)

    def _due(self, what: str, period_s: float) -> bool:
        now = time.monotonic()
        if now - self._told[what] < period_s:
            return False
        self._told[what] = now
        return True

    def _publish(self, topic: str, kind: str, now: float | None = None, **fields: Any) -> None:
        message = wire.encode_message(kind, time=time.time() if now is None else now, **fields)
        try:
            self._link.publish(self._keys.monitor(topic), message, droppable=True)
        except LinkError as error:
            _log.warning("monitors are not told of this %s: %s", kind, error)
