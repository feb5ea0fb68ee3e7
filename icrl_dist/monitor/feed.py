"""Sources of the live view: a live run, or a recording played from a run folder."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, Protocol, Self

from icrl_dist.monitor.catch_up import CatchUp
from icrl_dist.monitor.evaluation import EvaluationReader, running
from icrl_dist.monitor.recording import Recording
from icrl_dist.monitor.run_state import RunState
from icrl_dist.stream.link import Link

PERIOD_S = 0.25
"""Time between two ticks of the run state."""


class Feed(Protocol):
    """Keeps a run state up to date on its own thread."""

    state: RunState

    def now(self) -> float:
        """The current time of the run state, Unix seconds."""
        ...

    def replay(self) -> dict[str, Any] | None:
        """Position in a recording: ``begin``, ``end``, ``at`` (Unix seconds), ``speed``, ``paused``; None for a live run.

        ``loading``: whether the state is not there yet, because reading the recording takes longer.
        """
        ...

    def control(self, speed: float | None = None, paused: bool | None = None, at: float | None = None) -> None:
        """Set the speed of a recording, pause or resume it, or seek to ``at``; does nothing for a live run."""
        ...

    def close(self) -> None: ...


class LiveFeed:
    """A live run, over a link to its learner."""

    def __init__(self, link: Link, run: str = "", folder: Path | None = None) -> None:
        """Subscribes to the monitor plane of ``run``, by default of all runs at that endpoint; asks for its past.

        ``folder``: the run folder, if it is on this machine: the evaluation runs when the learner has ended.
        """
        self.state = RunState(run)
        self._evaluation = None if folder is None else EvaluationReader(folder, self.state)
        self._ended, self._lock = threading.Event(), threading.Lock()
        self._epoch = ""
        """Epoch of the state whose past was requested."""
        self._collecting = ""
        """The phase that is being collected."""
        self._past = CatchUp(link, self.state)
        link.subscribe(f"icrl/{run or '*'}/mon/**", self._receive)
        self._thread = threading.Thread(target=self._tick, name="run-state", daemon=True)
        self._thread.start()

    def _receive(self, key: str, payload: bytes) -> None:
        with self._lock:
            self.state.receive(key, payload, time.time())
            if self._begin():
                self.state.receive(key, payload, time.time())
            before, self._collecting = self._collecting, self.state.collecting
            if before and before != self._collecting and self.state.working:
                self._past.collected(self.state.name, before)

    def _begin(self) -> bool:
        """Request the past of a run that was just selected; returns whether there was one."""
        if not self.state.name or self.state.epoch == self._epoch:
            return False
        self._past.begin(self.state.name)
        self._epoch, self._collecting = self.state.epoch, ""
        return True

    def _tick(self) -> None:
        while not self._ended.wait(PERIOD_S):
            with self._lock:
                self._begin()
                self.state.tick(time.time())

    def now(self) -> float:
        return time.time()

    def replay(self) -> dict[str, Any] | None:
        return None

    def control(self, speed: float | None = None, paused: bool | None = None, at: float | None = None) -> None:
        """A live run has no controls."""

    def close(self) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self._past.close()
        if self._evaluation is not None:
            self._evaluation.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ReplayFeed:
    """A run on disk, finished or crashed, played from its dataset and metrics."""

    def __init__(self, folder: Path, speed: float = 10.0, at_end: bool = False) -> None:
        """``speed``: recorded seconds played in a second; ``at_end``: begin with the state at the end.

        Raises ConfigError if there is nothing to play.
        """
        self.state = RunState(recorded=True)
        self._recording = Recording(folder)
        self._lock = threading.Lock()
        self._speed, self._paused, self._seek = speed, False, False
        self._evaluation = EvaluationReader(folder, self.state)
        at_end = at_end or running(folder)  # a run that is evaluated now is not past
        self._at = self._recording.end if at_end else self._recording.begin
        self._played = self._recording.begin
        """Time of the newest message that the state has received."""
        self._messages = self._recording.messages()
        self._next = next(self._messages, None)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._play, name="replay", daemon=True)
        self._thread.start()

    def _play(self) -> None:
        last = time.monotonic()
        while not self._ended.wait(PERIOD_S):
            with self._lock:
                elapsed, last = time.monotonic() - last, time.monotonic()
                if not self._paused:
                    self._at = min(self._recording.end, self._at + elapsed * self._speed)
                at, seek, self._seek = self._at, self._seek, False
            if seek:
                self.state.clear()
                self._played = self._recording.begin
                self._messages = self._recording.messages()
                self._next = next(self._messages, None)
            self._play_until(at)

    def _play_until(self, at: float) -> None:
        """Receive all messages up to ``at``, with a tick after every recorded second, as in a live run."""
        last_tick = None
        while self._next is not None and self._next[0] <= at and not self._ended.is_set():
            time_, key, payload = self._next
            self._played = time_
            if last_tick is None:
                last_tick = time_
            if time_ - last_tick >= 1.0:
                last_tick = time_
                self.state.tick(time_)
            self.state.receive(key, payload, time_)
            self._next = next(self._messages, None)
        self._played = at
        self.state.tick(at)

    def now(self) -> float:
        return self._at

    def replay(self) -> dict[str, Any] | None:
        with self._lock:
            where = {"begin": self._recording.begin, "end": self._recording.end, "at": self._at}
            loading = self._at - self._played > max(5.0, 4 * PERIOD_S * self._speed)
            return {**where, "speed": self._speed, "paused": self._paused, "loading": loading}

    def control(self, speed: float | None = None, paused: bool | None = None, at: float | None = None) -> None:
        with self._lock:
            if speed is not None:
                self._speed = min(1e4, max(0.1, speed))
            if paused is not None:
                self._paused = paused
            if at is not None:
                self._seek = at < self._at or self._seek
                self._at = min(self._recording.end, max(self._recording.begin, at))

    def close(self) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self._evaluation.close()
        self._recording.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
