"""The learner as a child process of ``icrl-dist train``: its events, what it is told, its restarts, its end."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, Run

Report = Callable[[dict[str, Any]], None]


class TrainFailed(RuntimeError):  # noqa: N818
    """The run failed; one line for the user."""


@contextlib.contextmanager
def running(run: Run, folder: Path) -> Iterator[Learner]:
    """A learner process for the run in this folder; when all is over it has ended."""
    learner = Learner(folder, run.stream.endpoint, run.learner.restarts)
    try:
        yield learner
    finally:
        learner.end()


class Learner:
    """The learner process: its events, its restarts, its end."""

    def __init__(self, folder: Path, endpoint: str, restarts: int) -> None:
        self._folder, self.endpoint, self._budget = folder, endpoint, restarts
        self._queue: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._error = ""
        self._finished = False
        self._excused: list[str] = []
        self.deaths = 0
        """Times that it was killed and started again."""
        self._start()

    def _start(self) -> None:
        command = [sys.executable, "-m", "learner", str(self._folder), "--endpoint", self.endpoint]
        self._log = (self._folder / "learner.err").open("ab")
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._log, start_new_session=True)
        threading.Thread(target=self._read, args=(self._process,), name="learner events", daemon=True).start()

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                self._queue.put(json.loads(line))

    def events(self) -> Iterator[dict[str, Any]]:
        """What happened since the last call; waits a tenth of a second at most for the first."""
        wait = 0.1
        while True:
            try:
                event = self._queue.get(timeout=wait)
            except queue.Empty:
                return
            wait = 0.001
            if event["event"] == "listening":
                self.endpoint = event["endpoint"]
            elif event["event"] == "error":
                self._error = event["text"]
            elif event["event"] == "finished":
                self._finished = True
            yield event

    def excuse(self, workers: Sequence[str]) -> None:
        """Tell it of the workers, of all so far, that were lost with their machines: their jobs are not to blame."""
        if new := workers[len(self._excused) :]:
            self._excused += new
            self._tell(new)

    def _tell(self, workers: Sequence[str]) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has died, and the next one is told
            os.write(self._process.stdin.fileno(), json.dumps(workers).encode() + b"\n")

    def watch(self, report: Report) -> None:
        """Start the learner again from its checkpoint if it was killed.

        Raises ConfigError or TrainFailed with its own words if it gave up, TrainFailed if it
        was killed more often than the budget allows.
        """
        code = self._process.poll()
        if code is None or self._finished:
            return
        time.sleep(0.1)
        for event in self.events():
            report(event)
        if self._finished:
            return
        if self._error:
            raise (ConfigError if code == 2 else TrainFailed)(self._error)
        if self._budget == 0:
            raise TrainFailed(f"the learner died too often (exit code {code}); its last words are in {self._log.name}")
        self._budget -= 1
        self.deaths += 1
        report({"event": "note", "text": f"the learner died (exit code {code}); starting it again from its checkpoint"})
        self._let_go()
        self._start()
        self._tell(self._excused)

    def interrupt(self, report: Report) -> None:
        """Ask it to write a checkpoint and end."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=60)
        for event in self.events():
            report(event)

    def end(self) -> None:
        """Wait for a finished learner, end any other, and leave nothing behind."""
        try:
            if not self._finished:
                self._process.terminate()
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._let_go()

    def _let_go(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._log.close()
