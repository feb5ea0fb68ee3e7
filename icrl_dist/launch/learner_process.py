"""The learner as a child process of ``icrl-dist train``: events from it, messages to it, restarts, its end."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.console.display import ReportEvent
from icrl_dist.telemetry import processes
from icrl_dist.telemetry.logs import bound

CHECKPOINT_S = 60.0
"""Seconds that a learner has to write its checkpoint when the run ends."""


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
        self._processes: list[tuple[int, float]] = []
        self.deaths = 0
        """Number of restarts."""
        self._start()

    def _start(self) -> None:
        self._log = (self._folder / "learner.err").open("ab")
        events, write_end = os.pipe()
        try:
            command = processes.python("-m", "learner", str(self._folder), "--endpoint", self.endpoint)
            command += ["--events", str(write_end), "--driver", str(os.getpid())]
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=self._log,
                stderr=self._log,
                pass_fds=(write_end,),
                start_new_session=True,
                env=processes.environment(),
            )
        except BaseException:
            os.close(events)
            raise
        finally:
            os.close(write_end)
        threading.Thread(target=self._read, args=(events,), name="learner events", daemon=True).start()

    def _read(self, events: int) -> None:
        with open(events, "rb") as lines:
            for line in lines:
                if line.endswith(b"\n"):  # else the learner was killed while it wrote the line
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
            self._send(lost=new)

    def end_after_driver(self, processes: Iterable[psutil.Process]) -> None:
        """Let the learner end these processes of this computer if this process dies before them."""
        for process in processes:
            with contextlib.suppress(psutil.Error):
                if process.pid != self._process.pid:
                    self._processes.append((process.pid, process.create_time()))
        self._send(processes=self._processes)

    def _send(self, **message: Sequence[Any]) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the learner has died; watch() sends everything to the next one
            os.write(self._process.stdin.fileno(), json.dumps(message).encode() + b"\n")

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
        self._send(lost=self._excused, processes=self._processes)

    def interrupt(self, report: ReportEvent) -> None:
        """End the learner, which writes a checkpoint first."""
        self._stop()
        for event in self.events():
            report(event)

    def end(self) -> None:
        """Wait for the learner if it has finished, else end it as ``interrupt`` does; close its files."""
        self._stop()
        self._close_files()

    def _stop(self) -> None:
        """Wait for a finished learner, terminate another one; kill it if it has not ended when its time is over."""
        if not self._finished:
            self._process.terminate()
        try:
            self._process.wait(timeout=10 if self._finished else CHECKPOINT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _close_files(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._log.close()
