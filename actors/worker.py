"""A worker: ask for a job, do it, stream every trajectory, ask again."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import icrl_dist
from actors.policy import LivePolicy
from icrl_dist import jobs
from icrl_dist.config import Run, parse
from icrl_dist.envs import tasks
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import Keys, Link, Unanswered
from icrl_dist.types import Job, Trajectory

_log = logging.getLogger(__name__)


class Worker:
    """One worker on its own link.  Nothing is pushed at it; it holds at most one job."""

    def __init__(self, link: Link, run_name: str, name: str, patience_s: float = 60.0) -> None:
        """``patience_s``: how long the learner may be away before the worker gives up."""
        self._link, self._keys, self.name, self._patience_s = link, Keys(run_name), name, patience_s
        self._stop = threading.Event()
        self._episodes = self._steps = 0
        self._beat = 0.0

    def stop(self) -> None:
        """End after the job at hand."""
        self._stop.set()

    def run(self) -> None:
        """Work until the learner says stop.

        Raises Refused if the learner refuses this worker or its trajectories, Unanswered if
        the learner is away for longer than ``patience_s``.
        """
        self._link.announce(self._keys.alive(self.name))
        _, hello = self._ask("hello", version=icrl_dist.__version__, pid=os.getpid())
        run = parse(hello["run"], "the learner's run")
        policy = LivePolicy(self._link, self._keys, tasks.spec(run), run.model, run.stream.max_message_bytes)
        credit = CreditSender(self._link, self._keys.data, run.stream.credits, run.stream.reply_timeout_s)
        with contextlib.closing(credit) as sender:
            while not self._stop.is_set():
                kind, fields = self._ask("ask")
                if kind == "stop":
                    return
                if kind == "wait":
                    self._heartbeat("", sender.resent)
                    self._stop.wait(float(fields["seconds"]))
                else:
                    self._do(wire.decode_job(fields["job"]), policy, sender, run)

    def _do(self, job: Job, policy: LivePolicy, sender: CreditSender, run: Run) -> None:
        name = job.label
        try:
            for trajectory in jobs.do(job, policy, self.name):
                sender.send(wire.encode_trajectory(trajectory))
                self._episodes += 1
                self._steps += len(trajectory.actions)
                self._show(trajectory)
                self._heartbeat(name, sender.resent)
            sender.drain(timeout_s=run.stream.lease_s)
        except Unanswered as error:
            _log.warning("job %s given back: %s", name, error)
        except Exception as error:
            _log.exception("job %s failed", name)
            line = traceback.extract_tb(error.__traceback__)[-1]
            text = f"{type(error).__name__}: {error} ({os.path.basename(line.filename)}:{line.lineno})"  # noqa: PTH119
            self._ask("failed", job=list(job.name), error=text)

    def _ask(self, kind: str, **fields: object) -> tuple[str, dict[str, Any]]:
        payload = wire.encode_message(kind, worker=self.name, **fields)
        reply = patiently(lambda: self._link.request(self._keys.work, payload, timeout_s=5.0), self._patience_s)
        return wire.decode_message(reply)

    def _show(self, trajectory: Trajectory) -> None:
        message = wire.monitor_trajectory(trajectory, time.time())
        self._link.publish(self._keys.monitor(f"trajectory/{self.name}"), message, droppable=True)

    def _heartbeat(self, job: str, resent: int) -> None:
        if time.monotonic() - self._beat > 0.5:
            self._beat = time.monotonic()
            counters: dict[str, Any] = {"episodes": self._episodes, "steps": self._steps, "resent": resent}
            message = wire.encode_message("worker", worker=self.name, job=job, time=time.time(), **counters)
            self._link.publish(self._keys.monitor(f"worker/{self.name}"), message, droppable=True)


def patiently(request: Callable[[], bytes], patience_s: float) -> bytes:
    """Ask again while the learner is away.  Raises Unanswered after ``patience_s``, Refused at once."""
    deadline, pause = time.monotonic() + patience_s, 0.05
    while True:
        try:
            return request()
        except Unanswered:
            if time.monotonic() + pause > deadline:
                raise
            time.sleep(pause)
            pause = min(1.0, 2 * pause)
