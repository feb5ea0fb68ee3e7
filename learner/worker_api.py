"""The desk that workers come to: who is there, who gets which job, and what went wrong with it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import icrl_dist
from icrl_dist import version
from icrl_dist.config.run import Run, dumps
from icrl_dist.stream import messages, wire
from icrl_dist.stream.dispatch import Dispatcher
from icrl_dist.stream.link import Link, Query, StreamKeys
from icrl_dist.stream.validation import read
from icrl_dist.telemetry import crash_reports
from icrl_dist.types import Job
from learner.scheduler import Board

HOPELESS = 8
"""So many variations quarantined and nothing stored in a phase: the fault is in none of them, and the run ends."""

_MOMENT_S = 0.3
"""A vanished worker's stacks may be on their way, over a network's file system."""

_LINES = 60
"""So many of a worker's stacks are in its record, the newest call of the first thread first."""

_COUNTS = ("episodes", "steps", "resent", "trajectories", "waited_s")


class Desk:
    """Answers workers from the Board and watches them come and go."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        link: Link,
        keys: StreamKeys,
        board: Board,
        lock: threading.Lock,
        report: Callable[[dict[str, Any]], None],
        fail: Callable[[str], None],
        acting: Callable[[Job], int] | None = None,
    ) -> None:
        """``lock`` guards the Board; ``fail`` ends the run with a line for the user.

        Crash records go into the run's ``folder``.  ``acting`` as in ``Board.lease``; it is
        called with the lock held.
        """
        self._run, self._board, self._lock, self._report, self._fail = run, board, lock, report, fail
        self._folder, self._acting = folder, acting
        self.workers: dict[str, bool] = {}
        """Every worker seen, and whether it is alive."""
        self.counters: dict[str, dict[str, Any]] = {}
        """The newest that each worker said of itself: episodes, steps, resent, memory_mb and so on."""
        self._heard: dict[str, float] = {}
        self._jobs: dict[str, Job] = {}
        self._told: set[tuple[str, int, int, int]] = set()
        self._finished = threading.Event()
        self._later = Dispatcher("crash records")
        link.serve(keys.work, self._work)
        link.subscribe(keys.heartbeats, lambda _, payload: self._beat(payload))
        link.watch(keys.alive_all, self._watch)

    @property
    def resent(self) -> int:
        """Times that a trajectory had to be sent again, by all workers so far."""
        return sum(said["resent"] for said in list(self.counters.values()))

    @property
    def told(self) -> dict[str, Any]:
        """What all workers said of themselves together; for how long each has been silent, and those here have waited."""
        now, said = time.monotonic(), list(self.counters.values())
        here = [worker for worker, alive in list(self.workers.items()) if alive and worker in self.counters]
        return {
            "episodes": sum(one["episodes"] for one in said),
            "acknowledged": sum(one["trajectories"] for one in said),
            "resent": self.resent,
            "waited_s": sum(one["waited_s"] for one in said),
            "waited": {worker: self.counters[worker]["waited_s"] for worker in here},
            "silent": {worker: now - heard for worker, heard in list(self._heard.items())},
        }

    @property
    def doing(self) -> list[str]:
        """What the workers that are here say of work that takes long."""
        here = [worker for worker, alive in sorted(self.workers.items()) if alive]
        said = (str(self.counters.get(worker, {}).get("doing", "")) for worker in here)
        return [f"{worker}: {text[:100]}" for worker, text in zip(here, said, strict=True) if text]

    def finish(self) -> None:
        """From now on, tell whoever asks to stop."""
        self._finished.set()

    def dismiss(self, timeout_s: float = 3.0) -> None:
        """After the end: wait until every worker has been told to stop, or time is up, and tidy up."""
        deadline = time.monotonic() + timeout_s
        while any(self.workers.values()) and time.monotonic() < deadline:
            time.sleep(0.02)
        crash_reports.sweep(self._folder)

    def excuse(self, workers: Collection[str]) -> None:
        """These workers went with their machines: what was held against their jobs, and is still open, is taken back."""
        with self._lock:
            before = set(self._board.quarantined)
            for worker in workers:
                self._board.excuse(worker)
            again = before - set(self._board.quarantined)
            self._told -= again
        for key in sorted(again):
            name = "/".join(map(str, key))
            text = f"variation {name} is tried again: its workers went with their machines"
            self._report({"event": "released", "identity": name, "text": text})

    def close(self) -> None:
        """Write no more crash records; the link stays open."""
        self._later.close()

    def _watch(self, worker: str, alive: bool) -> None:
        if alive:
            self._join(worker)
        else:
            self._leave(worker)

    def _join(self, worker: str) -> None:
        with self._lock:
            again = self.workers.get(worker) is False
            self.workers[worker] = True
            self._heard.pop(crash_reports.predecessor(worker) or "", None)  # nobody waits for that one any more
            self._board.back(worker)
        text = f"worker {worker} {'is back' if again else 'joined'}"
        self._report({"event": "worker", "worker": worker, "alive": True, "text": text})

    def _leave(self, worker: str) -> None:
        crashed = not self._finished.is_set()
        cause = f"worker {worker} died"
        if crashed and self._stacks(worker):
            cause += f": {self._stacks(worker)[0]}"
        with self._lock:
            self.workers[worker] = False
            job = self._jobs.pop(worker, None)
            freed = self._board.lost(worker, time.monotonic(), cause)
        text = f"worker {worker} is gone"
        if freed:
            text += "; its job goes to another: " + ", ".join(job.label for job in freed)
        self._report({"event": "worker", "worker": worker, "alive": False, "text": text})
        if crashed:
            self._later.post(lambda: self._vanished(worker, job), _MOMENT_S)
        self._tell_quarantines()

    def _vanished(self, worker: str, job: Job | None) -> None:
        """The record of a worker that went without a word: killed, crashed in C, or stuck."""
        if self.workers[worker]:
            return  # it was cut off and is back
        stacks = self._stacks(worker)
        record = {
            "what": "vanished",
            "worker": worker,
            "time": time.time(),
            "job": job.label if job else "",
            "seed": self._run.seed,
            "last_said": self.counters.get(worker, {}),
            "stacks": stacks,
        }
        why = stacks[0] if stacks else "without a word"
        self._record(record, f"worker {worker} vanished ({why})")

    def _stacks(self, worker: str) -> list[str]:
        """First lines of what the worker's watchdog wrote, if anything."""
        try:
            with crash_reports.stacks_of(self._folder, worker).open(errors="replace") as file:
                return [line.rstrip() for line, _ in zip(file, range(_LINES), strict=False)]
        except FileNotFoundError:
            return []

    def _record(self, record: dict[str, Any], text: str) -> None:
        try:
            text += f"; {crash_reports.write(self._folder, record)}"
        except OSError as error:
            text += f"; its record cannot be written: {error}"
        self._report({"event": "crash", "worker": record["worker"], "text": text})

    def _tell_quarantines(self) -> None:
        with self._lock:
            new = {key: cause for key, cause in self._board.quarantined.items() if key not in self._told}
            self._told.update(new)
            phases = {key[:2] for key in new}
            hopeless = [phase for phase in phases if self._hopeless(*phase)]
        for key, cause in new.items():
            name = "/".join(map(str, key))
            text = f"variation {name} is quarantined, the run goes on without it: {cause}"
            self._report({"event": "quarantine", "identity": name, "cause": cause, "text": text})
        for stage, round_ in hopeless:
            found = self._board.blamed(stage, round_)
            self._fail(
                f"{stage}/{round_}: not one trajectory was stored, and {len(found)} of its variations are quarantined; "
                f"first: {found[0][1]}"
            )

    def _hopeless(self, stage: str, round_: int) -> bool:
        arrived, expected = self._board.progress(stage, round_)
        return not arrived and (not expected or len(self._board.blamed(stage, round_)) >= HOPELESS)

    def _beat(self, payload: bytes) -> None:
        kind, fields = wire.decode_message(payload)
        if kind == "worker":
            self._hear(fields)

    def _hear(self, fields: dict[str, Any]) -> None:
        """What a worker says of itself; a heartbeat may be overtaken, so counts never fall."""
        progress = read(messages.Progress, fields, "progress")
        worker = progress.worker
        with self._lock:
            before = self.counters.get(worker, {})
            counts = {name: max(getattr(progress, name), before.get(name, 0)) for name in _COUNTS}
            self.counters[worker] = {**before, **fields, **counts}
            self._heard[worker] = time.monotonic()
            self._board.reached(worker, progress.job, progress.reached)

    def _work(self, query: Query) -> None:
        try:
            kind, fields = wire.decode_message(query.payload, self._run.stream.max_message_bytes)
            query.reply(self._answer(kind, fields))
        except wire.WireError as error:
            query.refuse(f"schema: {error.detail}")
        except (KeyError, TypeError, ValueError) as error:
            query.refuse(f"schema: {error}")

    def _answer(self, kind: str, fields: dict[str, Any]) -> bytes:
        if kind not in messages.REQUESTS:
            raise ValueError(f"message kind {kind!r}: expected hello, ask, failed or note")
        request: Any = read(messages.REQUESTS[kind], fields, kind)
        worker = request.worker
        match request:
            case messages.Hello():
                if request.version != icrl_dist.__version__:
                    raise ValueError(f"worker {worker} runs icrl-dist {request.version}, the learner {icrl_dist.__version__}")
                if request.code != version.digest():
                    theirs = request.code[:8]
                    raise ValueError(f"worker {worker} runs icrl-dist's code {theirs}, the learner {version.digest()[:8]}")
                return wire.encode_message("hello", run=dumps(self._run))
            case messages.Progress():
                self._hear(fields)
                return self._lease(worker)
            case messages.Failed():
                self._failed(worker, request.job, request.record, request.file)
            case messages.Note():
                self._report({"event": "note", "text": f"worker {worker}: {request.text[:200]}"})
        return wire.encode_message("noted")

    def _lease(self, worker: str) -> bytes:
        if self._finished.is_set():
            return wire.encode_message("stop")
        with self._lock:
            lease = self._board.lease(worker, time.monotonic(), self._acting)
            if lease is None:
                self._jobs.pop(worker, None)
                return wire.encode_message("wait", seconds=0.1)
            self._jobs[worker] = lease.job
        return wire.encode_message("job", job=wire.encode_job(lease.job), deadline_s=lease.deadline_s)

    def _failed(self, worker: str, name: tuple[str, int, int, int], record: dict[str, Any], file: str) -> None:
        with self._lock:
            self._board.failed(worker, name, str(record["exception"]))
        text = f"worker {worker}: job {record['job']} failed: {record['exception']}"
        kept = crash_reports.folder_of(self._folder) / Path(file).name
        if file and kept.is_file():
            self._report({"event": "crash", "worker": worker, "text": f"{text}; {kept}"})
        else:
            self._record({**record, "worker": Path(worker).name}, text)
        self._tell_quarantines()
