"""Rollout worker: requests jobs from the learner, does them and sends each trajectory when its episode ends."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from torch import nn

import icrl_dist
from actors.beliefs import BeliefPublisher
from actors.publisher import TrajectoryPublisher
from actors.watchdog import Watchdog
from actors.weight_cache import WeightCache
from icrl_dist import version as code
from icrl_dist.collect import kinds
from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, parse
from icrl_dist.interfaces import EndsRun, Problem
from icrl_dist.methods import registry as methods
from icrl_dist.models.kernel import require_kernel
from icrl_dist.problems import registry as problems
from icrl_dist.stream import messages, wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.excerpts import plain
from icrl_dist.stream.link import Link, LinkError, Refused, StreamKeys, Unanswered
from icrl_dist.stream.validation import read
from icrl_dist.telemetry import crash_reports
from icrl_dist.types import Identity, Job, Payload, Trajectory

_log = logging.getLogger(__name__)

_ENVELOPE = 64
"""Bytes, at most, that a request adds to a single trajectory."""
HEARTBEAT_S = 0.5
"""Seconds between heartbeats."""


class Worker:
    """One worker on its own link.  It requests its jobs and has at most one at a time."""

    def __init__(self, link: Link, run_name: str, name: str, patience_s: float = 60.0, folder: Path | None = None) -> None:
        """``patience_s``: seconds without an answer of the learner after which the worker ends.

        ``folder``: the run folder, for a worker that is the only one in its process.  The worker writes its
        crash records there, and the stacks of its threads when the watchdog ends it after a deadline.
        """
        self._link, self._keys, self.name, self._patience_s = link, StreamKeys(run_name), name, patience_s
        self._folder = folder
        self._stop = threading.Event()
        self._episodes = self._steps = 0
        self._job = self._doing = ""
        self._policy_version, self._reached = -1, 0
        self._publisher = TrajectoryPublisher(link, self._keys, name)

    def stop(self) -> None:
        """End after the current job."""
        self._stop.set()

    def run(self) -> None:
        """Do jobs until the learner answers ``stop``.

        Raises Refused if the learner refuses this worker, Unanswered if the learner does not answer for
        longer than ``patience_s``.
        """
        self._link.announce(self._keys.alive(self.name))
        sources = {name: list(source) for name, source in plugins.sources().items()}
        identity = {"version": icrl_dist.__version__, "code": code.digest(), "plugins": sources, "pid": os.getpid()}
        _, hello = self._request("hello", **identity)
        run = parse(read(messages.Welcome, hello, "hello").run, "the learner's run")
        if run.context.decoder == "kernel":
            try:
                require_kernel()
            except ConfigError as error:
                raise Refused(str(error)) from None
        problem, method = problems.of(run), methods.of(run)
        weights = WeightCache(self._link, self._keys, method.build(problem.spec, run), run.stream.max_message_bytes)
        sender = CreditSender(self._link, self._keys.data, run.stream.credits, run.stream.reply_timeout_s)
        beliefs = BeliefPublisher(self._link, self._keys.monitor(f"belief/{self.name}"), self.name, problem)
        watchdog = Watchdog(self._folder, self.name)
        with contextlib.closing(watchdog), contextlib.closing(sender), self._heartbeat(sender):
            while not self._stop.is_set():
                kind, fields = self._request("ask", **self._count(sender))
                if kind == "stop":
                    return
                if kind == "wait":
                    self._stop.wait(read(messages.Wait, fields, kind).seconds)
                else:
                    lease = read(messages.LeasedJob, fields, kind)
                    job = self._decode(lease, problem)
                    if job is None:
                        continue
                    paused = _PausedWatchdog(weights, watchdog)
                    work = functools.partial(kinds.do, job, problem, method, paused, self.name, self._report, beliefs)
                    self._do(job, work, lease.deadline_s, sender, watchdog, run)

    def _decode(self, lease: messages.LeasedJob, problem: Problem) -> Job | None:
        """The leased job; None if it cannot be decoded, which is reported to the learner as a failure of the job."""
        try:
            return wire.decode_job(lease.job, functools.partial(_read_payload, problem))
        except Exception as error:  # a problem's own payload may raise anything
            label = "/".join(map(str, lease.name))
            _log.exception("job %s cannot be decoded", label)
            self._fail(lease.name, crash_reports.raised(self.name, label, error))
            return None

    def _do(
        self,
        job: Job,
        work: Callable[[], Iterator[Trajectory]],
        deadline_s: float,
        sender: CreditSender,
        watchdog: Watchdog,
        run: Run,
    ) -> None:
        """Do a job, each trajectory within ``deadline_s``, not counting the time in which it waits for the learner."""
        drain_s, largest = run.stream.lease_s, run.stream.max_message_bytes
        self._job, self._policy_version = job.label, job.policy_version
        made: set[Identity] = set()
        try:
            trajectories = work()
            while (trajectory := _next(trajectories, watchdog, deadline_s)) is not None:
                made.add(trajectory.identity)
                self._episodes += 1
                self._steps += len(trajectory.actions)
                sender.send(_encoded(trajectory, largest))
                self._publisher.publish(trajectory)
            self._publisher.flush()
            sender.drain(timeout_s=drain_s)
        except Unanswered as error:
            _log.warning("job %s ended without its result, so the learner leases it again: %s", job.label, error)
        except Exception as error:
            _log.exception("job %s failed", job.label)
            refused = isinstance(error, Refused)  # then the reason names the trajectory
            current = None if refused else next((identity for identity in job.identities() if identity not in made), None)
            record = crash_reports.raised(self.name, job.label, error, job, current)
            _drain(sender, drain_s)
            self._fail(job.name, record, plain(str(error), messages.LINE) if isinstance(error, EndsRun) else "")
        finally:
            self._job, self._doing, self._reached = "", "", 0

    def _fail(self, name: tuple[str, int, int, int], record: dict[str, Any], ends_run: str = "") -> None:
        self._request("failed", job=list(name), record=record, file=self._write(record), ends_run=ends_run)

    def _report(self, text: str, note: bool = False, reached: int = 0) -> None:
        """Send a note to the learner at once; other texts are part of the next heartbeat."""
        text = plain(text, messages.LINE)
        if note:
            self._request("note", text=text)
        else:
            self._doing, self._reached = text, reached

    def _write(self, record: dict[str, Any]) -> str:
        """Write a crash record into the run folder, if it is on this node; returns the file name, or an empty string."""
        try:
            return crash_reports.write(self._folder, record).name if self._folder else ""
        except OSError as error:
            _log.warning("the crash record could not be written here, so the learner writes it: %s", error)
            return ""

    def _request(self, kind: str, **fields: object) -> tuple[str, dict[str, Any]]:
        payload = wire.encode_message(kind, worker=self.name, **fields)
        reply = request_with_retries(lambda: self._link.request(self._keys.work, payload, timeout_s=5.0), self._patience_s)
        return wire.decode_message(reply)

    def _count(self, sender: CreditSender) -> dict[str, float]:
        return {
            "episodes": self._episodes,
            "steps": self._steps,
            "resent": sender.resent,
            "trajectories": sender.acknowledged,
            "waited_s": round(sender.waited_s, 3),
        }

    @contextlib.contextmanager
    def _heartbeat(self, sender: CreditSender) -> Iterator[None]:
        """Send heartbeats to the monitor plane meanwhile, from a thread of its own, so a job cannot block them."""
        ended = threading.Event()

        def beat() -> None:
            key = self._keys.monitor(f"worker/{self.name}")
            while True:
                fields = {**self._count(sender), **crash_reports.memory()}
                now = {
                    "job": self._job,
                    "doing": self._doing,
                    "reached": self._reached,
                    "policy_version": self._policy_version,
                    "pid": os.getpid(),
                    "time": time.time(),
                }
                message = wire.encode_message("worker", worker=self.name, **now, **fields)
                try:
                    self._link.publish(key, message, droppable=True)
                    self._publisher.flush()
                except LinkError as error:
                    _log.warning("a heartbeat could not be sent: %s", error)
                if ended.wait(HEARTBEAT_S):
                    return

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join(5.0)


def _read_payload(problem: Problem, kind: str, data: Any) -> Payload:
    return kinds.read_payload(kind, problem, data)


def _encoded(trajectory: Trajectory, largest: int) -> bytes:
    """The trajectory as a message.  Raises WireError if it is larger than the learner accepts."""
    payload = wire.encode_trajectory(trajectory)
    if len(payload) + _ENVELOPE > largest:
        detail = f"{trajectory.identity} has {len(payload)} bytes: raise stream.max_message_bytes = {largest}"
        raise wire.WireError("oversized", detail)
    return payload


class _PausedWatchdog:
    """The weights that a job requests; the watchdog pauses while the worker waits for them."""

    def __init__(self, weights: WeightCache, watchdog: Watchdog) -> None:
        self._weights, self._watchdog = weights, watchdog

    def at(self, version: int) -> tuple[nn.Module, str]:
        with self._watchdog.paused():
            return self._weights.at(version)


def _next(work: Iterator[Trajectory], watchdog: Watchdog, deadline_s: float) -> Trajectory | None:
    with watchdog.deadline(deadline_s):
        return next(work, None)


def _drain(sender: CreditSender, timeout_s: float) -> None:
    """Wait until the learner has stored or refused the trajectories of a failed job, so the next job starts without them."""
    while True:
        try:
            sender.drain(timeout_s)
        except Refused as error:
            _log.warning("another trajectory of the failed job was refused: %s", error)
        except Unanswered as error:
            _log.warning("trajectories of the failed job are not answered yet: %s", error)
            return
        else:
            return


def request_with_retries(request: Callable[[], bytes], patience_s: float) -> bytes:
    """Repeat a request until the learner answers.  Raises Unanswered after ``patience_s``, Refused at once."""
    deadline, pause = time.monotonic() + patience_s, 0.05
    while True:
        try:
            return request()
        except Unanswered:
            if time.monotonic() + pause > deadline:
                raise
            time.sleep(pause)
            pause = min(1.0, 2 * pause)
