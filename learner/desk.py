"""The desk that workers come to: who is there, who gets which job, and what went wrong with it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import icrl_dist
from icrl_dist.config import Run, dumps
from icrl_dist.stream import wire
from icrl_dist.stream.link import Keys, Link, Query
from learner.work import Board


class Desk:
    """Answers workers from the Board and watches them come and go."""

    def __init__(
        self,
        run: Run,
        link: Link,
        keys: Keys,
        board: Board,
        lock: threading.Lock,
        report: Callable[[dict[str, Any]], None],
        fail: Callable[[str], None],
    ) -> None:
        """``lock`` guards the Board; ``fail`` ends the run with a line for the user."""
        self._run, self._board, self._lock, self._report, self._fail = run, board, lock, report, fail
        self.workers: dict[str, bool] = {}
        """Every worker seen, and whether it is alive."""
        self._finished = threading.Event()
        link.serve(keys.work, self._work)
        link.watch(keys.alive_all, self._watch)

    def finish(self) -> None:
        """From now on, tell whoever asks to stop."""
        self._finished.set()

    def dismiss(self, timeout_s: float = 3.0) -> None:
        """After the end: wait until every worker has been told to stop, or time is up."""
        deadline = time.monotonic() + timeout_s
        while any(self.workers.values()) and time.monotonic() < deadline:
            time.sleep(0.02)

    def _watch(self, worker: str, alive: bool) -> None:
        with self._lock:
            self.workers[worker] = alive
            freed = [] if alive else self._board.lost(worker)
        text = f"worker {worker} joined" if alive else f"worker {worker} is gone"
        if freed:
            text += "; its job goes to another: " + ", ".join(job.label for job in freed)
        self._report({"event": "worker", "worker": worker, "alive": alive, "text": text})

    def _work(self, query: Query) -> None:
        try:
            kind, fields = wire.decode_message(query.payload, self._run.stream.max_message_bytes)
            query.reply(self._answer(kind, fields))
        except (wire.WireError, KeyError, TypeError, ValueError) as error:
            query.refuse(f"schema: {error}")

    def _answer(self, kind: str, fields: dict[str, Any]) -> bytes:
        worker = str(fields["worker"])
        if kind == "hello":
            if fields["version"] != icrl_dist.__version__:
                raise ValueError(f"worker {worker} runs icrl-dist {fields['version']}, the learner {icrl_dist.__version__}")
            return wire.encode_message("hello", run=dumps(self._run))
        if kind == "ask":
            if self._finished.is_set():
                return wire.encode_message("stop")
            with self._lock:
                job = self._board.lease(worker, time.monotonic())
            return (
                wire.encode_message("wait", seconds=0.1)
                if job is None
                else wire.encode_message("job", job=wire.encode_job(job))
            )
        if kind == "failed":
            stage, round_, task = fields["job"]
            self._report({"event": "note", "text": f"worker {worker}: job {stage}/{round_}/{task} failed: {fields['error']}"})
            with self._lock:
                final = self._board.failed((stage, round_, task), str(fields["error"]))
            if final:
                self._fail(final)
            return wire.encode_message("noted")
        raise ValueError(f"message kind {kind!r}: expected hello, ask or failed")
