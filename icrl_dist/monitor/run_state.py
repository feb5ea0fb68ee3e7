"""State of a run as the live view shows it: bounded in memory, and built from monitor messages only.

Messages are untrusted: a message that does not match docs/tap.md is counted and ignored.
``snapshot`` returns plain values for a page or a terminal, complete or only what has changed.
"""

from __future__ import annotations

import threading
import uuid
from collections import Counter, deque
from typing import Any

from icrl_dist.console import phase_names
from icrl_dist.monitor import headline, readers, validation
from icrl_dist.monitor.rates import RateSeries
from icrl_dist.monitor.validation import InvalidMessageError
from icrl_dist.monitor.variations import VariationTable
from icrl_dist.monitor.workers import WorkerTable
from icrl_dist.stream import validation as strict
from icrl_dist.types import STAGES

MAX_BYTES = 1 << 20
"""Larger messages are ignored."""
_SILENT_S = 3.0
"""The run is ``silent`` if its learner has sent nothing for this time."""
_ABANDONED_S = 15.0
"""After this silence the view switches to another run at the same endpoint."""
_MAX_BELIEFS = 16
_BELIEF_S = 60.0
"""Age at which a belief is removed.  A worker sends a belief rarely (after 200 times its cost) where it costs much."""
_MAX_VARIATIONS = 4096
"""Limit on the variations in one message."""
_OVER = ("finished", "evaluating", "interrupted", "failed")


class RunState:
    """State of one run, built from its monitor messages; safe to use from several threads.

    Times are Unix seconds: the clock of this computer for a live run, recorded times for a recording.
    """

    def __init__(self, run: str = "", recorded: bool = False) -> None:
        """``run``: name of the only run to show; by default the first run whose learner sends a message.

        ``recorded``: the messages come from a recording, which has no heartbeats, so nothing counts as silent.
        """
        self._lock, self._only, self._recorded = threading.RLock(), run, recorded
        self._evaluation: dict[str, Any] | None = None
        self._evaluating, self._evaluated = False, 0
        self._seq = 0
        self.clear()

    def clear(self) -> None:
        """Remove everything; the next snapshot of each viewer is a full one, because ``epoch`` changes."""
        with self._lock:
            self.epoch = uuid.uuid4().hex[:8]
            self.ignored: Counter[str] = Counter()
            """Number of ignored messages by reason."""
            self.received = 0
            """Number of messages, ignored ones included."""
            self._seq = 0
            self._run: dict[str, Any] = {"name": self._only, "state": "waiting", "version": -1, "trajectories": 0}
            self._last_message = float("-inf")
            """When the learner's newest message arrived."""
            self._workers = WorkerTable(not self._recorded)
            self._variations = VariationTable()
            self._rates = RateSeries()
            self._events: deque[dict[str, Any]] = deque(maxlen=readers.MAX_EVENTS)
            self._event_count = 0
            self._alerts: dict[str, dict[str, Any]] = {}
            self._beliefs: dict[str, dict[str, Any]] = {}
            self.past = ""
            """``loading`` while returns from before this view are requested, ``missing`` if the learner does not answer."""

    # Called by the feed.

    @property
    def name(self) -> str:
        """Name of the run that is shown; empty if there is none yet."""
        return str(self._run["name"])

    @property
    def working(self) -> bool:
        """Whether the run collects or fits, so its learner can answer."""
        return self._run["state"] in ("collecting", "fitting")

    @property
    def collecting(self) -> str:
        """The phase that is being collected, as ``adapt/1``; empty otherwise."""
        with self._lock:
            return "{phase}/{round}".format(**self._run) if self._run["state"] == "collecting" else ""

    @property
    def phases_so_far(self) -> list[str]:
        """The phases up to the present one, oldest first."""
        with self._lock:
            names = [f"{stage}/{number}" for stage, number, _ in self._rates.phases]
            now = "{phase}/{round}".format(**self._run) if "phase" in self._run else ""
            return names[: names.index(now) + 1] if now in names else []

    def has_all_phases(self, requested: int) -> bool:
        """Whether the returns of ``requested`` older phases would not be kept: every variation has as many newer ones."""
        with self._lock:
            return self._variations.complete(self._run.get("variations", 0), requested)

    def receive(self, key: str, payload: bytes, now: float, past: bool = False) -> None:
        """Take in one message of the monitor plane; any bytes are allowed.

        ``past``: an answer to a request, whose episodes were not finished now, so they do not count for rates.
        """
        try:
            message = strict.unpack(payload, MAX_BYTES)
            kind = validation.text(message.get("kind"), 32)
            _, run, _, topic = (*key.split("/"), "", "", "", "")[:4]
            if topic != kind:  # the access rules decide who may publish on a topic, so a kind has a topic of its own
                raise InvalidMessageError("wrong topic")
            run = validation.text(run, 200)
            with self._lock:
                self._apply(run, kind, message, now, past)
        except strict.WireError as error:
            self.ignored[error.reason] += 1
        except InvalidMessageError as error:
            self.ignored[str(error)] += 1
        self.received += 1

    def _apply(self, run: str, kind: str, message: dict[str, Any], now: float, past: bool) -> None:
        if kind == "learner":
            progress = readers.progress(message)
            self._select(run, now)
            self._apply_progress(progress, now)
        elif kind == "run":
            info = readers.run_info(message)
            self._select(run, now)
            self._apply_info(info)
        elif run != self._run["name"]:
            raise InvalidMessageError("another run" if self._run["name"] else "no run yet")
        elif kind == "trajectories":
            self._apply_returns(message, past)
        elif kind == "episode":
            self._variations.add_episode(validation.identity(message.get("identity")), message)
        elif kind == "worker":
            self._workers.heartbeat(message, now)
        elif kind == "event":
            self._apply_event(readers.event(message), now)
        elif kind == "belief":
            self._apply_belief(readers.belief(message), now)
        else:
            raise InvalidMessageError("unknown kind")

    def _select(self, run: str, now: float) -> None:
        """Show ``run``, whose learner sent a message, unless the run shown now is neither over nor silent for long.

        Raises InvalidMessageError if another run stays on view.
        """
        shown = self._run["name"]
        if shown and run != shown:
            abandoned = self._run["state"] in _OVER or now - self._last_message > _ABANDONED_S
            if self._only or not abandoned:
                raise InvalidMessageError("another run")
            self.clear()
        self._run["name"], self._last_message = run, now

    def _apply_returns(self, message: dict[str, Any], past: bool) -> None:
        worker, time = validation.text(message.get("worker")), validation.timestamp(message.get("time"))
        invalid = None
        for entry in validation.bounded_list(message.get("variations"), _MAX_VARIATIONS):
            try:
                added = self._variations.add_returns(validation.mapping(entry), worker, time)
                self._rates.count_episodes(0 if past else added)
            except InvalidMessageError as error:  # the valid entries of the message still count
                invalid = error
        if invalid:
            raise invalid

    def _apply_progress(self, progress: dict[str, Any], now: float) -> None:
        run = self._run
        if run["state"] not in _OVER or progress["time"] > run["ended"]:  # an interrupted run may resume
            run["state"] = {"collect": "collecting", "fit": "fitting"}[progress["stage"]]
            run.pop("ended", None)
        run.update({name: value for name, value in progress.items() if name != "time"})
        adapts = run["phase"] == "adapt"
        self._variations.begun = STAGES.index("adapt"), run["round"] + 1 if adapts else 0  # may begin before the next message
        self._variations.collecting = (STAGES.index(run["phase"]), run["round"]) if run["stage"] == "collect" else None
        self._rates.update(run, now)

    def _apply_info(self, info: dict[str, Any]) -> None:
        self._rates.phases, alerts = info.pop("phases"), info.pop("alerts")
        if alerts is not None:  # the complete list: an event about one of them may have been dropped
            self._alerts = {alert["name"]: alert for alert in alerts}
        self._run.update(info)

    def _apply_event(self, event: dict[str, Any], now: float) -> None:
        what, text, time = event["what"], event["text"], event["time"]
        if what == "worker":
            self._workers.set_alive(event["worker"], event["alive"], now)
            if not event["alive"]:
                self._beliefs.pop(event["worker"], None)
        elif what == "alert":
            name = event["alert"]
            if not event["active"]:
                self._alerts.pop(name, None)
            elif name in self._alerts or len(self._alerts) < readers.MAX_EVENTS:
                since = self._alerts.get(name, {"since": time})["since"]
                self._alerts[name] = {"name": name, "text": text, "since": since}
        elif what in ("quarantine", "released"):
            self._variations.set_quarantine(event["identity"], text if what == "quarantine" else "")
        elif what == "version":
            self._run["version"] = event["version"]
        elif what in _OVER and what != "evaluating":
            self._run["state"], self._run["ended"] = what, time
        self._event_count += 1
        self._events.append({"number": self._event_count, "time": time, "what": what, "text": text, "seq": self._seq + 1})

    def _apply_belief(self, belief: dict[str, Any], now: float) -> None:
        worker = belief.pop("worker")
        if worker in self._beliefs or len(self._beliefs) < _MAX_BELIEFS:
            self._beliefs[worker] = {**belief, "heard": now, "seq": self._seq + 1}

    # Called by the views.

    @property
    def seq(self) -> int:
        """Number of ticks so far."""
        return self._seq

    def set_evaluation(self, found: dict[str, Any] | None, running: bool) -> None:
        """Show held-out returns (``monitor.evaluation.held_out``), and whether an evaluation runs; ``clear`` keeps both."""
        with self._lock:
            if found != self._evaluation:
                self._evaluation, self._evaluated = found, self._seq + 1
            self._evaluating = running

    def tick(self, now: float, partial: bool = False, apart_s: float = 0.0) -> None:
        """Advance time: update rates, compute some optima, and remove old beliefs.

        ``partial``: only the learner's messages were received for this time, so the rates of workers are unknown;
        ``apart_s``: time between these messages, which were left out in between.
        """
        with self._lock:
            self._seq += 1
            self._workers.tick(now)
            rows = self._workers.rows(now)
            steps_per_s, unstored = sum(row["steps_per_s"] for row in rows), sum(row["unstored"] for row in rows)
            self._rates.tick(now, self._seq, self._run, steps_per_s, unstored, partial, apart_s)
            self._variations.tick(self._seq)
            self._beliefs = {w: b for w, b in self._beliefs.items() if now - b["heard"] <= _BELIEF_S}

    def snapshot(self, now: float, since: int = -1) -> dict[str, Any]:
        """The state as plain JSON values; of the large parts only what changed after ``since``.

        Pass ``seq`` of the result as ``since`` the next time.  ``epoch`` changes after ``clear``.
        docs/monitor.md lists the fields.
        """
        with self._lock:
            run = dict(self._run)
            silent_s = now - self._last_message
            if run["state"] in ("collecting", "fitting") and silent_s > _SILENT_S and not self._recorded:
                run["state"] = "silent"
            began = run.get("began")
            run["elapsed_s"] = max(0.0, run.get("ended", now) - began) if began is not None else None
            if run["state"] == "finished" and self._evaluating:
                run["state"] = "evaluating"
            working = run["state"] in ("collecting", "fitting")
            run["eta_s"] = self._rates.eta_s(run) if working else None
            run["stage_eta_s"] = self._rates.stage_eta_s(run) if working else None
            run["silent_s"] = max(0.0, silent_s) if self._last_message > float("-inf") else None
            run["rates"] = dict(self._rates.rates)
            run["round_text"], run["stage_text"] = phase_names.round_text(run), phase_names.stage_text(run)
            workers = self._workers.rows(now, run["state"] in _OVER, run["version"])
            changed, left_out = self._variations.changed(since)
            return {
                "epoch": self.epoch,
                "seq": self._seq,
                "since": since,
                "time": now,
                "headline": headline.headline(run, workers, len(self._alerts), self._evaluation),
                "run": run,
                "workers": workers,
                "variations": changed,
                "variation_count": len(self._variations),
                "variations_left_out": left_out,
                "averages": self._variations.averages(),
                "past": self.past,
                "evaluation": self._evaluation if self._evaluated > since else None,
                "episodes": self._variations.episodes(since),
                "series": self._rates.series(since),
                "history": self._rates.history(since),
                "events": [event for event in self._events if event["seq"] > since],
                "alerts": list(self._alerts.values()),
                "believers": list(self._beliefs),
                "beliefs": {w: b for w, b in self._beliefs.items() if b["seq"] > since},
                "heard": self.received,
                "ignored": dict(self.ignored),
            }

    def variation(self, name: str) -> dict[str, Any] | None:
        """Everything kept of the variation ``TASK/VARIATION``, with the lineage of its episodes; None if it is unknown."""
        with self._lock:
            return self._variations.detail(name)
