"""The learner as a child process of ``icrl-dist train``: events from it, messages to it, restarts, its end."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.console.display import ReportEvent
from icrl_dist.telemetry.logs import bound, stamp


class TrainFailed(RuntimeError):  # noqa: N818
    """The run failed; the message is one line for the user."""


@contextlib.contextmanager
def running(run: Run, folder: Path) -> Iterator[LearnerProcess]:
    """A learner process for the run in this folder; it has ended when the context ends."""
    learner = LearnerProcess(folder, run.stream.endpoint, run.learner.restarts)
    try:
        yield learner
    finally:
        learner.end()


class LearnerProcess:
    """A learner process that is restarted from its checkpoint if it is killed."""

    def __init__(self, folder: Path, endpoint: str, restarts: int) -> None:
        self._folder, self.endpoint, self._restarts_left = folder, endpoint, restarts
        self._queue: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._error = ""
        self._finished = False
        self._excused: list[str] = []
        self.deaths = 0
        """Number of restarts."""
        self._start()

    def _start(self) -> None:
        command = [sys.executable, "-m", "learner", str(self._folder), "--endpoint", self.endpoint]
        self._log = (self._folder / "learner.err").open("ab")
        self._log.write(f"{stamp()} the learner starts\n".encode())
        self._log.flush()
        pipe = subprocess.PIPE
        environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}  # idle torch threads sleep: decision 073
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=self._log, start_new_session=True, env=environment
        )
        threading.Thread(target=self._read, args=(self._process,), name="learner events", daemon=True).start()

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                self._queue.put(json.loads(line))

    def events(self) -> Iterator[dict[str, Any]]:
        """Events since the last call; waits at most 0.1 s for the first one."""
        timeout_s = 0.1
        while True:
            try:
                event = self._queue.get(timeout=timeout_s)
            except queue.Empty:
                return
            timeout_s = 0.001
            if event["event"] == "listening":
                self.endpoint = event["endpoint"]
            elif event["event"] == "error":
                self._error = event["text"]
            elif event["event"] == "finished":
                self._finished = True
            yield event

    def excuse(self, workers: Sequence[str]) -> None:
        """Send the learner the workers that were lost with their nodes, so that their jobs do not count as failed.

        ``workers``: all such workers since the start of the run; only the new ones are sent.
        """
        if new := workers[len(self._excused) :]:
            self._excused += new
            self._send(new)

    def _send(self, workers: Sequence[str]) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the learner has died; watch() sends the list to the next one
            os.write(self._process.stdin.fileno(), json.dumps(workers).encode() + b"\n")

    def watch(self, report: ReportEvent) -> None:
        """Restart the learner from its checkpoint if it was killed.

        Raises ConfigError or TrainFailed with the learner's message if it ended with an error, and
        TrainFailed if it was killed more often than ``learner.restarts``.
        """
        bound(self._folder / "learner.err")
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
        if self._restarts_left == 0:
            raise TrainFailed(f"the learner died too often (exit code {code}); its error output is in {self._log.name}")
        self._restarts_left -= 1
        self.deaths += 1
        report({"event": "note", "text": f"the learner died (exit code {code}); restarting it from its checkpoint"})
        self._close_files()
        self._start()
        self._send(self._excused)

    def interrupt(self, report: ReportEvent) -> None:
        """End the learner, which writes a checkpoint first."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=60)
        for event in self.events():
            report(event)

    def end(self) -> None:
        """Wait for the learner if it has finished, else terminate it; close its files."""
        try:
            if not self._finished:
                self._process.terminate()
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._close_files()

    def _close_files(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._log.close()
