"""What the live view knows of a run: a bounded picture, made of what the monitor plane says.

Nothing here trusts a message: one that is not what docs/tap.md says is counted and left out.
``snapshot`` gives plain values for a page or a terminal, whole or only what has changed.
"""

from __future__ import annotations

import threading
import uuid
from collections import Counter, deque
from typing import Any

from icrl_dist.monitor import readers, validation
from icrl_dist.monitor.rates import RateSeries
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.monitor.variations import VariationTable
from icrl_dist.monitor.workers import WorkerTable
from icrl_dist.stream import validation as strict

LARGEST = 1 << 20
"""A message of more bytes than this is left out."""
_SILENT_S = 3.0
"""A learner that says nothing for so long is called silent."""
_LEFT_S = 15.0
"""After so long a silence another run at the same endpoint is shown."""
_BELIEFS = 16
_BELIEF_S = 60.0
"""An older belief is of an episode long over; where it costs much a worker tells of one that seldom (200 times its cost)."""
_VARIATIONS = 4096
"""Of which a message tells, at most."""
_OVER = ("finished", "interrupted", "failed")


class RunState:
    """A run as its monitor plane shows it; safe to use from several threads.

    Times are Unix seconds: of this machine while a run is watched, of then while one is replayed.
    """

    def __init__(self, run: str = "", recorded: bool = False) -> None:
        """``run``: the name of the only one that is shown; empty for whichever is on.

        ``recorded``: heartbeats were not kept, so nobody is called silent.
        """
        self._lock, self._only, self._recorded = threading.RLock(), run, recorded
        self.clear()

    def clear(self) -> None:
        """Forget everything; a viewer that asks for changes is given the whole picture once more."""
        with self._lock:
            self.epoch = uuid.uuid4().hex[:8]
            self.ignored: Counter[str] = Counter()
            """Messages left out, by reason."""
            self.heard = 0
            """Messages, those left out among them."""
            self._seq = 0
            self._run: dict[str, Any] = {"name": self._only, "state": "waiting", "version": -1, "trajectories": 0}
            self._heard = float("-inf")
            self._staff = WorkerTable(not self._recorded)
            self._curves = VariationTable()
            self._pace = RateSeries()
            self._events: deque[dict[str, Any]] = deque(maxlen=readers.EVENTS)
            self._event_count = 0
            self._alerts: dict[str, dict[str, Any]] = {}
            self._beliefs: dict[str, dict[str, Any]] = {}

    # What the feed calls.

    def hear(self, key: str, payload: bytes, now: float) -> None:
        """Take in one message of the monitor plane, whatever it is."""
        try:
            message = strict.unpack(payload, LARGEST)
            kind = validation.text(message.get("kind"), 32)
            run = validation.text(key.partition("/")[2].partition("/")[0], 200)
            with self._lock:
                self._take(run, kind, message, now)
        except strict.WireError as error:
            self.ignored[error.reason] += 1
        except InvalidMessageError as error:
            self.ignored[str(error)] += 1
        self.heard += 1

    def _take(self, run: str, kind: str, message: dict[str, Any], now: float) -> None:
        if kind == "learner":
            told = readers.progress(message)
            self._meet(run, now)
            self._progress(told, now)
        elif kind == "run":
            told = readers.about(message)
            self._meet(run, now)
            self._begin(told)
        elif run != self._run["name"]:
            raise InvalidMessageError("another run" if self._run["name"] else "no run yet")
        elif kind == "trajectories":
            self._returned(message)
        elif kind == "episode":
            self._curves.drawn(validation.identity(message.get("identity")), message)
        elif kind == "worker":
            self._staff.beat(message, now)
        elif kind == "event":
            self._event(readers.event(message), now)
        elif kind == "belief":
            self._belief(readers.belief(message), now)
        else:
            raise InvalidMessageError("unknown kind")

    def _meet(self, run: str, now: float) -> None:
        """The learner of ``run`` speaks: it is shown from now on, unless another is that is neither over nor long silent.

        Raises InvalidMessageError if it is not to be shown.
        """
        shown = self._run["name"]
        if shown and run != shown:
            left = self._run["state"] in _OVER or now - self._heard > _LEFT_S
            if self._only or not left:
                raise InvalidMessageError("another run")
            self.clear()
        self._run["name"], self._heard = run, now

    def _returned(self, message: dict[str, Any]) -> None:
        worker, time, odd = validation.text(message.get("worker")), validation.timestamp(message.get("time")), None
        for told in validation.bounded_list(message.get("variations"), _VARIATIONS):
            try:
                self._pace.produced(self._curves.returned(validation.mapping(told), worker, time))
            except InvalidMessageError as error:  # the others are none the worse for it
                odd = error
        if odd:
            raise odd

    def _progress(self, told: dict[str, Any], now: float) -> None:
        run = self._run
        if run["state"] not in _OVER or told["time"] > run["ended"]:  # a run that was over may go on
            run["state"] = {"collect": "collecting", "fit": "fitting"}[told["stage"]]
            run.pop("ended", None)
        run.update({name: value for name, value in told.items() if name != "time"})
        self._pace.progress(run, now)

    def _begin(self, told: dict[str, Any]) -> None:
        self._pace.phases, alerts = told.pop("phases"), told.pop("alerts")
        if alerts is not None:  # the events tell of each once, if they arrive
            self._alerts = {alert["name"]: alert for alert in alerts}
        self._run.update(told)

    def _event(self, told: dict[str, Any], now: float) -> None:
        what, text, time = told["what"], told["text"], told["time"]
        if what == "worker":
            self._staff.came(told["worker"], told["alive"], now)
            if not told["alive"]:
                self._beliefs.pop(told["worker"], None)
        elif what == "alert":
            name = told["alert"]
            if not told["active"]:
                self._alerts.pop(name, None)
            elif name in self._alerts or len(self._alerts) < readers.EVENTS:
                since = self._alerts.get(name, {"since": time})["since"]
                self._alerts[name] = {"name": name, "text": text, "since": since}
        elif what in ("quarantine", "released"):
            self._curves.quarantined(told["identity"], text if what == "quarantine" else "")
        elif what == "version":
            self._run["version"] = told["version"]
        elif what in _OVER:
            self._run["state"], self._run["ended"] = what, time
        self._event_count += 1
        self._events.append({"number": self._event_count, "time": time, "what": what, "text": text, "seq": self._seq + 1})

    def _belief(self, told: dict[str, Any], now: float) -> None:
        worker = told.pop("worker")
        if worker in self._beliefs or len(self._beliefs) < _BELIEFS:
            self._beliefs[worker] = {**told, "heard": now, "seq": self._seq + 1}

    # What the views call.

    @property
    def seq(self) -> int:
        """How often time has gone on."""
        return self._seq

    def tick(self, now: float) -> None:
        """Time goes on: rates, who is silent, what is not yet known of a variation's optimum."""
        with self._lock:
            self._seq += 1
            self._staff.tick(now)
            rows = self._staff.rows(now)
            steps_per_s, unstored = sum(row["steps_per_s"] for row in rows), sum(row["unstored"] for row in rows)
            self._pace.tick(now, self._seq, self._run, steps_per_s, unstored)
            self._curves.tick(self._seq)
            self._beliefs = {w: b for w, b in self._beliefs.items() if now - b["heard"] <= _BELIEF_S}

    def snapshot(self, now: float, since: int = -1) -> dict[str, Any]:
        """All that is known, as plain values that JSON can hold; of what is large only that changed after ``since``.

        ``seq`` is what to give as ``since`` next time, ``epoch`` changes when everything was
        forgotten.  docs/monitor.md has the fields.
        """
        with self._lock:
            run = dict(self._run)
            if run["state"] in ("collecting", "fitting") and now - self._heard > _SILENT_S and not self._recorded:
                run["state"] = "silent"
            began = run.get("began")
            run["elapsed_s"] = max(0.0, run.get("ended", now) - began) if began is not None else None
            working = run["state"] in ("collecting", "fitting")
            run["eta_s"] = self._pace.eta_s(run) if working else None
            run["stage_eta_s"] = self._pace.stage_eta_s(run) if working else None
            run["silent_s"] = max(0.0, now - self._heard) if self._heard > float("-inf") else None
            run["rates"] = dict(self._pace.rates)
            changed, left_out = self._curves.changed(since)
            return {
                "epoch": self.epoch,
                "seq": self._seq,
                "since": since,
                "time": now,
                "run": run,
                "workers": self._staff.rows(now, run["state"] in _OVER, run["version"]),
                "variations": changed,
                "variation_count": len(self._curves),
                "variations_left_out": left_out,
                "episodes": self._curves.episodes(since),
                "series": self._pace.series(since),
                "events": [event for event in self._events if event["seq"] > since],
                "alerts": list(self._alerts.values()),
                "believers": list(self._beliefs),
                "beliefs": {w: b for w, b in self._beliefs.items() if b["seq"] > since},
                "heard": self.heard,
                "ignored": dict(self.ignored),
            }

    def variation(self, name: str) -> dict[str, Any] | None:
        """All that is kept of one variation, named ``TASK/VARIATION``, its lineage among it; None if it is not known."""
        with self._lock:
            return self._curves.detail(name)
