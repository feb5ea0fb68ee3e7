"""Worker API: answers the requests of workers, leases jobs to them, and records their failures."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import icrl_dist
from icrl_dist import version
from icrl_dist.config import plugins
from icrl_dist.config.run import Run, dumps
from icrl_dist.stream import messages, wire
from icrl_dist.stream.dispatch import Dispatcher
from icrl_dist.stream.excerpts import plain, show
from icrl_dist.stream.link import Link, Query, StreamKeys
from icrl_dist.stream.schema import as_data
from icrl_dist.stream.validation import read
from icrl_dist.telemetry import crash_reports
from icrl_dist.telemetry.budget import Budget
from icrl_dist.types import Job
from learner.known_workers import MAX_WORKERS, KnownWorkers
from learner.scheduler import LeaseScheduler

_log = logging.getLogger(__name__)

MAX_QUARANTINED = 8
"""The run ends if a phase has this many quarantined variations and no stored trajectory: no single variation is the cause."""

_STACKS_DELAY_S = 0.3
"""Seconds to wait for the stacks of a worker that ended: a network file system may show them later."""

_LINES = 60
"""Lines of a worker's stacks in its crash record; the newest call of the first thread comes first."""

_REPORTS, _REPORTS_PER_S = MAX_WORKERS, 5.0
"""Lines about workers at once, and a second after them: a worker can cause any number of them."""


class WorkerAPI:
    """Answers workers with leases of the scheduler, and records when they connect, disconnect and fail."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        link: Link,
        keys: StreamKeys,
        scheduler: LeaseScheduler,
        lock: threading.Lock,
        report: Callable[[dict[str, Any]], None],
        fail: Callable[[str], None],
        policy_version: Callable[[Job], int] | None = None,
    ) -> None:
        """``lock`` guards the scheduler; ``fail`` ends the run with one line for the user.

        Crash records are written into the run ``folder``.  ``policy_version`` as in
        ``LeaseScheduler.lease``; it is called while the lock is held.
        """
        self._run, self._scheduler, self._lock, self._report, self._fail = run, scheduler, lock, report, fail
        self._folder, self._policy_version = folder, policy_version
        self.known = KnownWorkers()
        self._jobs: dict[str, Job] = {}
        self._reported: set[tuple[str, int, int, int]] = set()
        self._finished = threading.Event()
        self._closed = False
        self._budget, self._budget_lock = Budget(_REPORTS, _REPORTS_PER_S), threading.Lock()
        self._delayed = Dispatcher("crash records")
        link.serve(keys.work, self._on_request)
        link.subscribe(keys.heartbeats, self._on_heartbeat)
        link.watch(keys.alive_all, self._on_liveliness)

    def finish(self) -> None:
        """Answer every worker that asks for a job with "stop" from now on."""
        self._finished.set()

    def wait_until_gone(self, timeout_s: float = 3.0) -> None:
        """Wait after ``finish`` until every worker has ended, at most ``timeout_s``; remove empty stacks files."""
        deadline = time.monotonic() + timeout_s
        while any(self.known.alive.values()) and time.monotonic() < deadline:
            time.sleep(0.02)
        crash_reports.sweep(self._folder)

    def lost_with_node(self, workers: Collection[str]) -> None:
        """Record that these workers ended because their nodes failed: their deaths do not count against their jobs."""
        with self._lock:
            before = set(self._scheduler.quarantined)
            for worker in workers:
                self._scheduler.lost_with_node(worker)
            released = before - set(self._scheduler.quarantined)
            self._reported -= released
        for key in sorted(released):
            name = "/".join(map(str, key))
            text = f"variation {name} is leased again: its workers ended because their nodes failed"
            self._report({"event": "released", "identity": name, "text": text})

    def close(self) -> None:
        """Write no more crash records, and report no more workers that end; the link stays open."""
        self._closed = True
        self._delayed.close()

    def _report_of_worker(self, event: dict[str, Any]) -> None:
        """Report an event that a worker caused; ``_REPORTS`` limits them."""
        with self._budget_lock:
            if not self._budget.allows():
                return
            event["text"] += self._budget.note()
        self._report(event)

    def _on_liveliness(self, worker: str, alive: bool) -> None:
        if self._closed:
            return
        with self._lock:
            known = messages.is_name(worker) and (self.known.admit(worker, self._jobs) if alive else worker in self.known.alive)
        if not known:
            _log.warning("the liveliness token %s is ignored: %d workers are known", show(worker), len(self.known.alive))
        elif alive:
            self._connected(worker)
        else:
            self._disconnected(worker)

    def _connected(self, worker: str) -> None:
        with self._lock:
            again = self.known.alive.get(worker) is False
            self.known.alive[worker] = True
            replaced = crash_reports.predecessor(worker) or ""
            self.known.last_message.pop(replaced, None)  # this worker has been replaced, so its silence is no alert
            self._scheduler.worker_back(worker)
        text = f"worker {worker} {'is back' if again else 'joined'}"
        self._report_of_worker({"event": "worker", "worker": worker, "alive": True, "text": text})

    def _disconnected(self, worker: str) -> None:
        crashed = not self._finished.is_set()
        cause = f"worker {worker} died"
        if crashed and (stacks := self._stacks(worker)):
            cause += f": {stacks[0]}"
        with self._lock:
            self.known.alive[worker] = False
            job = self._jobs.pop(worker, None)
            freed = self._scheduler.worker_lost(worker, time.monotonic(), cause)
        text = f"worker {worker} is gone"
        if freed:
            text += "; its job will be leased again: " + ", ".join(job.label for job in freed)
        self._report_of_worker({"event": "worker", "worker": worker, "alive": False, "text": text})
        if crashed:
            self._delayed.post(lambda: self._record_end(worker, job), _STACKS_DELAY_S)
        self._report_quarantines()

    def _record_end(self, worker: str, job: Job | None) -> None:
        """Write the crash record of a worker that ended without a report: it was killed, crashed in C, or was stuck."""
        if self.known.alive.get(worker):
            return  # it was disconnected and is connected again
        stacks = self._stacks(worker)
        record = {
            "what": "vanished",
            "worker": worker,
            "time": time.time(),
            "job": job.label if job else "",
            "seed": self._run.seed,
            "last_heartbeat": self.known.counters.get(worker, {}),
            "stacks": stacks,
        }
        cause = stacks[0] if stacks else "no stacks were written: it was killed or disconnected"
        self._record(record, f"worker {worker} ended without a report ({cause})")

    def _stacks(self, worker: str) -> list[str]:
        """The first lines that the worker's watchdog wrote; empty if it wrote nothing."""
        try:
            with crash_reports.stacks_of(self._folder, worker).open(errors="replace") as file:
                return [plain(line.rstrip(), messages.LINE) for line, _ in zip(file, range(_LINES), strict=False)]
        except FileNotFoundError:
            return []

    def _record(self, record: dict[str, Any], text: str) -> None:
        try:
            text += f"; {crash_reports.write(self._folder, record)}"
        except OSError as error:
            text += f"; its crash record cannot be written: {error}"
        self._report_of_worker({"event": "crash", "worker": record["worker"], "text": text})

    def _report_quarantines(self) -> None:
        with self._lock:
            new = {key: cause for key, cause in self._scheduler.quarantined.items() if key not in self._reported}
            self._reported.update(new)
            phases = {key[:2] for key in new}
            failed = [phase for phase in phases if self._phase_failed(*phase)]
        for key, cause in new.items():
            name = "/".join(map(str, key))
            text = f"variation {name} is quarantined, the run continues without it: {cause}"
            self._report({"event": "quarantine", "identity": name, "cause": cause, "text": text})
        for stage, round_ in failed:
            found = self._scheduler.quarantine_causes(stage, round_)
            self._fail(
                f"{stage}/{round_}: no trajectory was stored, and {len(found)} of its variations are quarantined; "
                f"first: {found[0][1]}"
            )

    def _phase_failed(self, stage: str, round_: int) -> bool:
        arrived, expected = self._scheduler.progress(stage, round_)
        return not arrived and (not expected or len(self._scheduler.quarantine_causes(stage, round_)) >= MAX_QUARANTINED)

    def _on_heartbeat(self, key: str, payload: bytes) -> None:
        try:
            kind, fields = wire.decode_message(payload)
            if kind == "worker" and fields.get("worker") == key.rpartition("/")[2]:
                self._count(read(messages.Progress, fields, "heartbeat"), fields)
        except wire.WireError as error:
            _log.warning("a heartbeat is ignored: %s", str(error))  # the error itself would keep the message

    def _count(self, progress: messages.Progress, fields: dict[str, Any]) -> None:
        with self._lock:
            if not self.known.admit(progress.worker, self._jobs):
                raise wire.WireError("schema", f"{MAX_WORKERS} workers are known, the limit: end some")
            self.known.count(progress, fields)
            self._scheduler.reached(progress.worker, progress.job, progress.reached)

    def _on_request(self, query: Query) -> None:
        try:
            kind, fields = wire.decode_message(query.payload)
            query.reply(self._answer(kind, fields))
        except wire.WireError as error:
            query.refuse(f"schema: {error.detail}")
        except ValueError as error:
            query.refuse(f"schema: {error}")

    def _answer(self, kind: str, fields: dict[str, Any]) -> bytes:
        if kind not in messages.REQUESTS:
            raise ValueError(f"message kind {show(kind)} is not known; use hello, ask, failed or note")
        request: Any = read(messages.REQUESTS[kind], fields, kind)
        worker = request.worker
        match request:
            case messages.Hello():
                self._require_same_code(request)
                return wire.encode_message("hello", run=dumps(self._run))
            case messages.Progress():
                self._count(request, fields)
                return self._lease(worker)
            case messages.Failed():
                self._failed(worker, request)
            case messages.Note():
                self._report_of_worker({"event": "note", "text": f"worker {worker}: {plain(request.text)}"})
        return wire.encode_message("noted")

    def _require_same_code(self, hello: messages.Hello) -> None:
        """Raises ValueError, with the remedy, for a worker with other code than the learner's.

        Of other packages only those with the run's problem and method count.
        """
        worker = hello.worker
        if hello.version != icrl_dist.__version__:
            theirs, ours = hello.version, icrl_dist.__version__
            raise ValueError(f"worker {worker} runs icrl-dist {theirs}, the learner {ours}: install the same version")
        if hello.code != version.digest():
            theirs, ours = hello.code[:8], version.digest()[:8]
            raise ValueError(f"worker {worker} runs icrl-dist's code {theirs}, the learner {ours}: install the same code")
        for name, what in plugins.of_run(self._run.problem, self._run.method).items():
            here, there = plugins.sources().get(name), hello.plugins.get(name)
            if here != there:
                theirs, ours = plugins.text(there), plugins.text(here)
                raise ValueError(
                    f"{what}: worker {worker} has {theirs}, the learner has {ours}: install the same version on every node"
                )

    def _lease(self, worker: str) -> bytes:
        if self._finished.is_set():
            return wire.encode_message("stop")
        with self._lock:
            lease = self._scheduler.lease(worker, time.monotonic(), self._policy_version)
            if lease is None:
                self._jobs.pop(worker, None)
                return wire.encode_message("wait", seconds=0.1)
            self._jobs[worker] = lease.job
        job = lease.job
        return wire.encode_message("job", name=list(job.name), job=wire.encode_job(job), deadline_s=lease.deadline_s)

    def _failed(self, worker: str, failed: messages.Failed) -> None:
        """Record the failure of a job that the worker holds; a report about another job changes nothing."""
        record, file = failed.record, failed.file
        cause = plain(record.exception, messages.LINE)
        with self._lock:
            if not self._scheduler.job_failed(worker, failed.job, cause):
                return
            self._jobs.pop(worker, None)
        if failed.ends_run:
            self._fail(f"{plain(record.job)}: {plain(failed.ends_run, messages.LINE)}")
        text = f"worker {worker}: job {plain(record.job)} failed: {cause}"
        kept = crash_reports.folder_of(self._folder) / file
        if file and kept.is_file():
            self._report_of_worker({"event": "crash", "worker": worker, "text": f"{text}; {kept}"})
        else:
            known = {name: value for name, value in as_data(record).items() if value is not None}
            self._record({**known, "worker": worker}, text)
        self._report_quarantines()
